"""The folder of a run, where it cannot be renamed."""

from __future__ import annotations

import errno
import sys
from pathlib import Path

import pytest

from g3r.errors import InputError
from g3r.run.output_folder import OutputFolder, check_output_folder


def test_the_working_folder_takes_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Renamed and replaced, it would leave the user's shell in a removed folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes").write_text("mine")
    for text in ("first", "second"):
        check_output_folder(Path("."), {"run.json"}, replace=True)
        with OutputFolder(".", {"run.json"}) as run, run.result() as staged:
            (staged / "run.json").write_text(text)
        assert Path.cwd() == tmp_path
        assert Path("run.json").read_text() == text
        assert {path.name for path in Path(".").iterdir()} == {"run.json", "notes"}


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such file systems there")
def test_without_locks_a_file_keeps_runs_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with OutputFolder(tmp_path / "out") as run, run.result() as staged:
        (staged / "run.json").touch()
        with pytest.raises(InputError, match="another run is writing it"), OutputFolder(tmp_path / "out"):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
