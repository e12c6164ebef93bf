"""Figures that appear in several documents agree, and follow from the measurements."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.figures import README, TABLES, WHAT, marked, presets_table, rows, subjects


@pytest.mark.parametrize(("path", "marker"), TABLES, ids=lambda part: part.name if isinstance(part, Path) else part)
def test_a_table_says_what_was_measured(path: Path, marker: str) -> None:
    between = rf"<!-- {marker}:begin -->\n(.*?)\n<!-- {marker}:end -->"
    (found,) = re.findall(between, path.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert found.strip() == TABLES[path, marker]().strip(), "run `python -m tests.figures`"


def test_the_readme_says_which_subjects() -> None:
    sizes = [[float(one) for one in row["pixel x slice, mm"].split(" x ")] for row in subjects()]
    assert len(sizes) == 8
    ranges = [f"{min(column):g} to {max(column):g} mm" for column in zip(*sizes, strict=True)]
    text = " ".join(README.read_text(encoding="utf-8").split())
    assert "eight simulated subjects" in text
    assert f"pixels of {ranges[0]}, slices of {ranges[1]}" in text


def test_means_are_of_the_right_columns() -> None:
    (fast,) = [row for row in rows(presets_table()) if row["preset"] == "`fast`"]
    own = [float(row["`fast`, dB"]) for row in subjects()]
    assert min(own) < float(fast["three stacks, dB"]) < max(own)
    assert fast["two stacks, dB"] == ""
    assert [row["preset"] for row in marked(README, "presets")] == list(WHAT)


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) < 120
