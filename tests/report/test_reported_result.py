"""`result.report()`: the verdict as text, in a notebook, and as a page; arrays with their grid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r import GaussianReconstructor, load_stack
from g3r.errors import InputError
from g3r.output.record import RunRecord
from g3r.report.reported_result import ReportedResult
from g3r.report.verdict import verdict_of
from tests.faults.small_case import quick_settings
from tests.report.planted_head import SIDES, blob, brain, bright_corner, section_of


@pytest.fixture(scope="module")
def result(subject: Path) -> ReportedResult:
    """The result of a run of about a second."""
    stacks = [load_stack(subject / f"stack-{n}.nii.gz", subject / f"mask-{n}.nii.gz") for n in range(3)]
    return GaussianReconstructor(settings=quick_settings()).reconstruct(stacks)


def test_the_verdict_is_the_one_of_terminal_and_page(result: ReportedResult) -> None:
    report = result.report()
    assert report.verdict == verdict_of(result.record)
    lines = str(report).splitlines()
    assert lines[0].startswith(f"{report.verdict.word}: ")
    assert len(lines) == 1 + len(report.verdict.reasons)
    assert repr(report) == str(report)
    assert any("thickness" in line for line in lines)  # no sidecar states the thickness


def test_a_notebook_shows_it_with_pictures(result: ReportedResult) -> None:
    stacks = [replace(one, name="<script>.nii") for one in result.record.stacks]
    named = replace(result, record=replace(result.record, stacks=stacks))
    assert isinstance(named, ReportedResult)
    text = named.report()._repr_html_()
    assert text.count("data:image/png;base64,") == 3
    assert "&lt;script&gt;" in text
    assert "<script" not in text


def test_its_pictures_are_as_radiologists_read_them(result: ReportedResult) -> None:
    """The patient's right, and anterior, are on the left of the picture for any axes of the volume."""
    planted = replace(result, volume=blob(result.grid), mask=brain(result.grid))
    assert isinstance(planted, ReportedResult)
    sections = planted.report().sections
    assert [name for name, _ in sections] == list(SIDES)
    assert {name: bright_corner(section_of(picture)) for name, picture in sections} == dict.fromkeys(SIDES, "top left")


def test_the_page_is_written_where_it_is_asked_for(result: ReportedResult, tmp_path: Path) -> None:
    path = tmp_path / "my report.html"
    report = result.report(path)
    assert f"<h1>{report.verdict.word.capitalize()}</h1>" in path.read_text(encoding="utf-8")
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    with pytest.raises(InputError, match="replace=True"):
        result.report(path)
    result.report(path, replace=True)
    with pytest.raises(InputError, match="cannot be written"):
        result.report(tmp_path / "no such folder" / "report.html")


def test_arrays_and_their_grid_are_the_file(result: ReportedResult, tmp_path: Path) -> None:
    result.save(tmp_path / "out")
    for name, grid in (("volume", result.grid), ("density", result.prior_grid)):
        file = nib.Nifti1Image.from_filename(tmp_path / "out" / f"{name}.nii.gz")
        np.testing.assert_allclose(file.affine, grid.affine, atol=1e-5)  # headers are float32
        np.testing.assert_allclose(np.asarray(file.dataobj), getattr(result, name), rtol=1e-4, atol=1e-4)
    first = np.array(result.grid.shape) - 1.0
    np.testing.assert_allclose(result.grid.index(result.grid.world(first)), first, atol=1e-9)


def test_saving_writes_the_page_too(result: ReportedResult, tmp_path: Path) -> None:
    result.save(tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    verdict = result.report().verdict
    assert f"<h1>{verdict.word.capitalize()}</h1>" in page
    record = RunRecord.read(tmp_path / "out" / "run.json")
    assert record.verdict == verdict.word
    assert record.reasons == verdict.deciding


def test_a_page_that_cannot_be_made_costs_no_volume(
    result: ReportedResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(folder: Path, *others: object) -> None:
        raise InputError(f"{folder}/run.json: damaged")

    monkeypatch.setattr("g3r.report.page.write_report", fail)
    result.save(tmp_path / "out")
    assert (tmp_path / "out" / "volume.nii.gz").is_file()
    assert "report.html could not be written" in caplog.text


def test_a_volume_without_a_brain_has_no_pictures(result: ReportedResult) -> None:
    empty = replace(result, mask=np.zeros_like(result.mask))
    assert empty.report().sections == ()
