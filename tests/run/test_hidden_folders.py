"""Words of a command line without the folders of the user."""

from __future__ import annotations

from pathlib import Path

import pytest

from g3r.run.hidden_folders import HiddenFolders, name_alone


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("/data/JANE/a.nii.gz", "a.nii.gz"),
        ("--output=/data/JANE/out/", "--output=out"),
        ("--preset", "--preset"),
        ("fast", "fast"),
        ("0.8", "0.8"),
    ],
)
def test_a_word_keeps_the_name_alone(word: str, told: str) -> None:
    assert name_alone(word) == told


def test_relative_folders_are_hidden_in_each_spelling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "JANE" / "raw").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    hidden = HiddenFolders(["JANE/raw"])
    for spelled in ("JANE/raw", str(tmp_path / "JANE" / "raw")):
        assert hidden.left_out_of(f"{spelled}/a.nii.gz: no such file") == "a.nii.gz: no such file"
    assert hidden.left_out_of("voxels of 0.8 mm") == "voxels of 0.8 mm"
