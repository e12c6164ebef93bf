"""Process marks in file names, which show whether the writing process still runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from g3r.run.process_mark import is_left_over, process_mark


@pytest.fixture
def ended() -> str:
    """The id of an ended process."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return str(process.pid)


def test_an_ended_process_is_told_from_a_living_one(ended: str) -> None:
    place, number = process_mark().split("-")
    assert number == str(os.getpid())
    assert not is_left_over(f"{place}-{number}-abc")
    assert is_left_over(f"{place}-{ended}-abc")
    assert is_left_over(f"{place}-{ended}")


def test_other_names_are_nobodys(ended: str) -> None:
    place = process_mark().split("-")[0]
    assert not any(map(is_left_over, ("", "x", ended, place, f"{place}-", f"{place}-x-1", f"{place}x-{ended}")))


@pytest.mark.parametrize("differs", ["host", "container"])
def test_processes_of_other_places_cannot_be_judged(
    differs: str, ended: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another host, or another container with the same host name: an id that is free here may be in use there."""
    here = process_mark().split("-")[0]
    if differs == "host":
        monkeypatch.setattr("g3r.run.process_mark.socket.gethostname", lambda: "another")
    else:
        monkeypatch.setattr("g3r.run.process_mark.COUNT", tmp_path)
    there = process_mark().split("-")[0]
    assert there != here
    assert not is_left_over(f"{here}-{ended}-x")
    assert is_left_over(f"{there}-{ended}-x")


def test_without_linux_the_host_decides(ended: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("g3r.run.process_mark.COUNT", tmp_path / "nothing")
    assert is_left_over(f"{process_mark().split('-')[0]}-{ended}")
