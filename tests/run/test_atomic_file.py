"""Files that are written atomically."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from g3r.run.atomic_file import atomic_path, remove_leftovers, write_text
from g3r.run.process_mark import process_mark


def test_two_writers_of_one_number_do_not_meet(tmp_path: Path) -> None:
    """As in two containers, both with process 1: the file is that of the last writer, and complete."""
    path = tmp_path / "table.tsv"
    with atomic_path(path) as first:
        first.write_text("first")
        with atomic_path(path) as second:
            assert second != first
            assert second.name.endswith(".table.tsv")
            second.write_text("second")
        assert first.read_text() == "first"
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_of_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "table.tsv"
    write_text(path, "earlier")

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        fail()
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_the_umask_holds(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "table.tsv", "text")
    finally:
        os.umask(before)
    assert (tmp_path / "table.tsv").stat().st_mode & 0o777 == 0o640


def test_leftovers_of_this_place_alone_are_removed(tmp_path: Path) -> None:
    place, own = process_mark().split("-")
    nobodys = 4194399  # above the largest process id of Linux
    names = [f".{place}-{own}-a.x.ckpt", f".00000000-{nobodys}-a.x.ckpt", f".{place}-{nobodys}-a.x.txt", ".x.ckpt"]
    for name in (*names, f".{place}-{nobodys}-a.x.ckpt"):
        (tmp_path / name).write_text("")
    remove_leftovers(tmp_path, ".ckpt")
    assert {path.name for path in tmp_path.iterdir()} == set(names)
