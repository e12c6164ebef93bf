"""`g3r-infer --dicom`: the same volume as from NIfTI, and no information about the patient in the result."""

from __future__ import annotations

import argparse
import gzip
import json
import shlex
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nibabel as nib
import numpy as np
import pytest

from g3r import GaussianReconstructor
from g3r.cli.dicom_options import DicomInput, write_dicom
from g3r.cli.infer import main
from g3r.dicom.convert import converter
from g3r.dicom.study import read_study
from g3r.output.record import RunRecord
from g3r.output.result import ReconstructionResult
from tests.cli.test_infer import run
from tests.dicom.conftest import STACKS, THICKNESS_MM, Examination
from tests.dicom.dicom_files import LPS_FROM_RAS, TRACES, pydicom
from tests.faults.small_case import WHOLE, quick_settings

SERIES = [str(number) for number in STACKS]
"""Series numbers that are also chosen by default."""

COPY_MASK = """
import pathlib, shutil, sys
stack, mask, *of_series = sys.argv[1:]
number = pathlib.Path(stack).stem.split("-")[1]
shutil.copy(dict(pair.split("=", 1) for pair in of_series)[number], mask)
"""


def mask_command(examination: Examination, folder: Path) -> str:
    """A mask command that finds the masks of the series by their file names."""
    script = folder / "copy_mask.py"
    script.write_text(COPY_MASK)
    pairs = [f"{number}={path}" for number, path in zip(SERIES, examination.dicom_masks, strict=True)]
    return f"{shlex.join([sys.executable, str(script)])} {{stack}} {{mask}} {shlex.join(pairs)}"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings for runs of a second, in scanner space."""
    monkeypatch.setattr("g3r.cli.infer_task._settings", lambda options: quick_settings())


@pytest.fixture(scope="module")
def written(examination: Examination, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the result (`out`), the volume as DICOM (`series`) and the terminal output (`said.txt`)."""
    folder = tmp_path_factory.mktemp("written")
    options = ["--preset", "fast", "--no-prior", "--resolution", "3", "--threads", "1", "--space", "scanner"]
    masks = ["--mask-command", mask_command(examination, folder)]
    outputs = ["--output", folder / "out", "--dicom-out", folder / "series"]
    done = run("infer", "--dicom", examination.dicom, *masks, *options, *outputs)
    assert done.returncode == 0, done.stderr
    (folder / "said.txt").write_text(done.stdout + done.stderr)
    return folder


def texts_below(folder: Path) -> dict[str, bytes]:
    """All written files and terminal output, uncompressed."""
    found = {}
    for path in folder.rglob("*"):
        if path.is_file():
            found[path.name] = path.read_bytes()
        if path.name.endswith(".gz"):
            found[f"{path.name} unpacked"] = gzip.decompress(path.read_bytes())
        if path.name.endswith(".npz"):
            with zipfile.ZipFile(path) as archive:
                found |= {f"{path.name} {one}": archive.read(one) for one in archive.namelist()}
    return found


def test_nothing_of_the_patient_is_in_the_result(written: Path) -> None:
    texts = texts_below(written / "out") | {"said": (written / "said.txt").read_bytes()}
    assert set(WHOLE) <= set(texts)
    assert not [name for name, content in texts.items() if any(word in content for word in TRACES)]
    assert not [path for path in (written / "out").iterdir() if any(word in str(path).encode() for word in TRACES)]
    # the search works: it finds the texts in the one output that is meant to contain them
    assert any(word in content for content in texts_below(written / "series").values() for word in TRACES)


def test_the_record_says_where_everything_came_from(written: Path) -> None:
    record = RunRecord.read(written / "out" / "run.json")
    assert [stack.name for stack in record.stacks] == [f"series-{number}.nii" for number in STACKS]
    assert [(stack.thickness_mm, stack.thickness_from) for stack in record.stacks] == [(THICKNESS_MM, "sidecar")] * 3
    assert any(note.startswith("stacks made of DICOM by dcm2niix v1.") for note in record.notes)
    assert "series-9: left out, slice 7 of 12 is missing (image number 4)" in record.warnings
    assert "--dicom: 1 damaged DICOM files are left out; copy the folder again" in record.warnings


def test_the_table_is_printed(written: Path) -> None:
    said = (written / "said.txt").read_text()
    assert said.startswith("series  plane")
    assert "slice 7 of 12 is missing (image number 4)" in said
    assert f"DICOM:   {written / 'series'} (names the patient)" in said


def test_the_series_is_the_volume(written: Path) -> None:
    volume = nib.Nifti1Image.from_filename(written / "out" / "volume.nii.gz")
    data = np.asarray(volume.dataobj)
    images = [pydicom.dcmread(path) for path in sorted((written / "series").iterdir())]
    assert len(images) == data.shape[2]
    values = np.stack([one.pixel_array.T * float(one.RescaleSlope) + float(one.RescaleIntercept) for one in images], -1)
    assert np.abs(values[::-1, ::-1] - data).max() <= float(images[0].RescaleSlope) / 2 * (1 + 1e-4)
    for k, one in enumerate(images):
        corner = LPS_FROM_RAS @ volume.affine @ [data.shape[0] - 1, data.shape[1] - 1, k, 1]
        assert np.abs(np.array(one.ImagePositionPatient, float) - corner[:3]).max() < 1e-3


@pytest.mark.usefixtures("quick")
def test_the_volume_is_that_of_the_nifti_route(examination: Examination, tmp_path: Path) -> None:
    """The same bytes as from files that dcm2niix made by hand, and as from files of another origin.

    The headers of those differ in their last digits, and their rows are stored in the other order (`FileAxes`).
    """
    by_hand = ["-b", "y", "-z", "i", "-f", "%s", "-o", str(tmp_path), str(examination.dicom)]
    subprocess.run([converter(), *by_hand], check=True, capture_output=True)
    stacks = [tmp_path / f"{number}.nii.gz" for number in STACKS]
    masks = ["--masks", *examination.dicom_masks]
    for name, inputs in {
        "dicom": ["--dicom", examination.dicom, "--series", *SERIES, *masks],
        "by hand": ["--stacks", *stacks, *masks],
        "other": ["--stacks", *examination.stacks, "--masks", *examination.masks],
    }.items():
        words = [*inputs, "--threads", "1", "--quiet", "--output", tmp_path / name]
        assert main([str(word) for word in words]) == 0
    dicom, hand, other = (tmp_path / name / "volume.nii.gz" for name in ("dicom", "by hand", "other"))
    assert dicom.read_bytes() == hand.read_bytes() == other.read_bytes()


@pytest.mark.usefixtures("quick")
def test_the_same_order_as_asked_for(examination: Examination, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The converted images are deleted before the reconstruction begins."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    work = GaussianReconstructor.reconstruct
    left: list[Path] = []

    def reconstruct(self: GaussianReconstructor, *arguments: Any, **options: Any) -> ReconstructionResult:
        left.extend((tmp_path / "temporary").iterdir())
        return work(self, *arguments, **options)

    monkeypatch.setattr(GaussianReconstructor, "reconstruct", reconstruct)
    order = [2, 0]
    words = ["--series", *(SERIES[n] for n in order), "--masks", *(examination.dicom_masks[n] for n in order)]
    line = ["--dicom", examination.dicom, *words, "--thickness", "3", "3.1", "--threads", "1", "--output"]
    assert main([str(word) for word in (*line, tmp_path / "out", "--quiet")]) == 0
    record = RunRecord.read(tmp_path / "out" / "run.json")
    assert [(stack.name, stack.thickness_mm) for stack in record.stacks] == [
        ("series-7.nii", 3.0),
        ("series-3.nii", 3.1),
    ]
    assert not left


def test_an_interrupted_run_writes_no_dicom(
    examination: Examination, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    result: Any = SimpleNamespace(record=SimpleNamespace(partial=True))
    options = argparse.Namespace(dicom_out=tmp_path / "series")
    write_dicom(options, result, DicomInput(study=read_study(examination.dicom)))
    assert "--dicom-out: not written, because the run was interrupted" in caplog.text
    assert not list(tmp_path.iterdir())


def test_a_dry_run_shows_the_table_and_writes_nothing(
    examination: Examination, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    line = ["--dicom", str(examination.dicom), "--whole-image", "--no-prior", "--dry-run", "--output"]
    assert main([*line, str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert said.count(f"thickness {THICKNESS_MM:g} mm (sidecar)") == 3
    assert not list(tmp_path.iterdir())  # the private folder is gone


def test_stacks_and_a_reference(examination: Examination, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A misfit is kept on request, so that there is a warning to write."""
    settings = quick_settings()
    settings = replace(settings, registration=replace(settings.registration, leave_out_misfits=False))
    monkeypatch.setattr("g3r.cli.infer_task._settings", lambda options: settings)
    inputs = ["--stacks", *examination.stacks, "--masks", *examination.masks, "--threads", "1", "--quiet"]
    outputs = ["--dicom-reference", examination.dicom, "--dicom-out", tmp_path / "series", "--output", tmp_path / "out"]
    assert main([str(word) for word in (*inputs, *outputs)]) == 0
    one = pydicom.dcmread(tmp_path / "series" / "0001.dcm")
    assert str(one.PatientName).startswith("Xenobia")
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["verdict"] == "do not use"
    verdict = f"do not use: {'; '.join(record['reasons'])}"
    assert one.ImageComments == f"For research only, not for diagnosis; verdict: {verdict}"
    assert record["partial"] is False
