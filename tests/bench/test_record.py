"""Records: the machine, JSON written atomically, tables between markers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from g3r.bench.record import between_markers, machine, machine_line, markdown_table, put_between_markers, write_json
from g3r.errors import InputError
from g3r.run.machine import available_cores


def test_machine_says_what_seconds_depend_on() -> None:
    found = machine(1)
    assert found["cores"] == available_cores() >= 1
    assert found["threads"] == 1
    assert found["processor"]
    assert found["torch"]
    assert found["numba"]
    assert json.loads(json.dumps(found)) == found
    assert found["processor"] in machine_line(found)


def test_markdown_table() -> None:
    assert markdown_table(["a", "b"], [["x", 1], ["y", 2.5]]) == ("| a | b |\n| --- | ---: |\n| x | 1 |\n| y | 2.5 |")
    with pytest.raises(ValueError, match="row of 1 cells"):
        markdown_table(["a", "b"], [["x"]])


def test_only_what_is_between_the_markers_changes(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text("before\n<!-- t:begin -->\nold\n<!-- t:end -->\nafter | t:begin\n", encoding="utf-8")
    for _ in range(2):  # a second time changes nothing
        put_between_markers(path, "t", "\nnew \\1 line\n")
        assert path.read_text(encoding="utf-8") == (
            "before\n<!-- t:begin -->\nnew \\1 line\n<!-- t:end -->\nafter | t:begin\n"
        )


@pytest.mark.parametrize(
    "text", ["", "<!-- t:begin -->", "<!-- t:end --><!-- t:begin -->", "<!-- t:begin --><!-- t:end -->" * 2]
)
def test_markers_must_be_there_once(text: str) -> None:
    with pytest.raises(InputError, match="markers"):
        between_markers(text, "t", "x")


def test_a_document_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"page\.md: no such file"):
        put_between_markers(tmp_path / "page.md", "t", "x")


def test_json_is_written_whole(tmp_path: Path) -> None:
    write_json(tmp_path / "made" / "record.json", {"a": 1})
    assert json.loads((tmp_path / "made" / "record.json").read_text()) == {"a": 1}
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["record.json"]
