"""`g3r-infer` refuses DICOM that it cannot use, in one line that says what to do, and leaves nothing behind."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from g3r.cli.infer import main
from g3r.errors import InputError
from tests.dicom.conftest import DERIVED, Examination, block
from tests.dicom.dicom_files import Study

REFUSED = {
    "--stacks DIR": "is a folder of DICOM images; expected NIfTI, or pass the folder of the examination: "
    "g3r-infer --dicom DIR --output out",
    "--stacks DIR/IM00001": "is a DICOM image; expected NIfTI, or pass the folder of the examination: "
    "g3r-infer --dicom DIR --output out",
    "--dicom nowhere": "nowhere: does not exist; expected a folder of DICOM images",
    "--dicom DIR/IM00001": "is a file; expected a folder of DICOM images",
    "--dicom DIR --series 2": "--series 2: is not there; the folder has series 1, 3, 4, 5, 6, 7, 8, 9, 10",
    "--dicom DIR --series 9": "--series 9: slice 7 of 12 is missing (image number 4); leave it out",
    "--dicom DIR --dicom-out DIR/new": "lies in the folder that is read; choose another --dicom-out",
    "--dicom DIR --dicom-out DIR": "is not empty; expected a new or empty folder, choose another --dicom-out",
    "--dicom DIR --dicom-out out": "out: is --output, too; choose another --dicom-out",
    "--stacks a.nii --dicom-out o --dicom-reference nowhere": "nowhere: does not exist; expected a folder",
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_used_is_refused(
    line: str,
    examination: Examination,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    words = line.replace("DIR", str(examination.dicom)).split()
    assert main([*words, "--whole-image", "--output", "out"]) == 3
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("g3r-infer: ")
    assert REFUSED[line].replace("DIR", str(examination.dicom)) in said
    assert not list(tmp_path.iterdir())


def test_an_output_that_is_not_empty_is_refused_before_anything_is_read(
    examination: Examination, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["--dicom", str(examination.dicom), "--output", str(tmp_path)]) == 3
    said = capsys.readouterr()
    assert "is not empty; pass --force to replace an earlier result" in said.err
    assert said.out == ""


@pytest.mark.parametrize(("how", "code"), [(KeyboardInterrupt, 130), (InputError("series-3: x; y"), 3)])
def test_the_private_folder_goes_whatever_happens(
    how: type[BaseException] | BaseException,
    code: int,
    examination: Examination,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Path] = []

    def stop_later(path: Path, *arguments: object) -> None:
        seen.append(path)
        if len(seen) == 2:
            raise how

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("g3r.dicom.convert._check_geometry", stop_later)
    assert main(["--dicom", str(examination.dicom), "--output", str(tmp_path / "out"), "--whole-image"]) == code
    assert seen[0].is_relative_to(tmp_path)
    assert not list(tmp_path.iterdir())


def test_nothing_to_choose_is_refused_below_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Study(tmp_path).write(*block(), DERIVED, EchoTime=12)
    assert main(["--dicom", str(tmp_path), "--output", str(tmp_path / "out")]) == 3
    said = capsys.readouterr()
    assert "no: not T2-weighted (TE 12 ms)" in said.out
    assert "no series is a whole stack of T2-weighted slices (see the table); choose with --series" in said.err


@pytest.mark.parametrize(
    "line",
    [
        "--dicom d --stacks a.nii",
        "--stacks a.nii --series 3",
        "--stacks a.nii --dicom-out o",
        "--stacks a.nii --dicom-reference d",
        "--dicom d --dicom-out o --dicom-reference d",
        "--dicom d --masks a.nii",
        "--dicom d --masks auto auto",
        "--dicom d --series 3 4 --masks a.nii",
        "--dicom d --thickness 3 4",
        "--dicom d --series 3 4 --thickness 3 4 5",
        "--dicom d --series 3 3",
        "--dicom d --series",
        "--dicom d --keep-header-text",
    ],
)
def test_wrong_usage(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*line.split(), "--output", "out"])
    assert caught.value.code == 2
    assert capsys.readouterr().err.startswith("usage: g3r-infer")


@pytest.mark.parametrize("package", ["pydicom", "dcm2niix"])
def test_a_missing_package_is_named_with_what_to_install(
    package: str, examination: Examination, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setenv("PATH", "")
    assert main(["--dicom", str(examination.dicom), "--output", "out"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    way_on = "install the dicom extra: pip install '.[dicom]' in a checkout"
    assert line == f"g3r-infer: {package} is not installed; {way_on}"
