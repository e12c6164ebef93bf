"""The folder of a run, where it cannot be renamed."""

from __future__ import annotations

from pathlib import Path

import pytest

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
