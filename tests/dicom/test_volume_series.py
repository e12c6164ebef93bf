"""A volume as DICOM: geometry, values, references, repeated patient attributes, atomic writing."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.dicom.convert import converter
from g3r.dicom.headers import read_images
from g3r.dicom.study import SourceStudy, read_study
from g3r.dicom.volume_series import DESCRIPTION, check_new_folder, write_volume_series
from g3r.errors import InputError
from tests.dicom.conftest import block, tilt
from tests.dicom.dicom_files import LPS_FROM_RAS, PERSONAL, Study, pydicom

KEPT = {"PatientName", "PatientID", "PatientBirthDate", "PatientSex", "PatientAge", "StudyDate", "StudyTime"} | {
    "StudyID",
    "StudyDescription",
    "AccessionNumber",
    "ReferringPhysicianName",
}
"""Attributes of the examination."""

OURS = {"SeriesDate", "ContentDate", "ImageComments"}
"""Attributes that are new in the series."""


@pytest.fixture
def study(tmp_path: Path) -> SourceStudy:
    (tmp_path / "source").mkdir()
    written = Study(tmp_path / "source")
    for number in (3, 9001):
        written.write(*block(), number)
    return read_study(tmp_path / "source")


def volume() -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """An oblique volume with different voxel sizes, so that exchanged axes are noticed."""
    rng = np.random.default_rng(5)
    data = rng.normal(300, 200, (7, 9, 5)).astype(np.float32)
    return data, tilt() @ np.diag([0.8, 0.9, 1.1, 1.0])


def read(folder: Path) -> list[Any]:
    return [pydicom.dcmread(path) for path in sorted(folder.iterdir())]


def test_an_empty_mount_point_is_written(study: SourceStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("g3r.run.output_folder.is_mount", lambda folder: True)
    (tmp_path / "out" / "lost+found").mkdir(parents=True)
    write_volume_series(tmp_path / "out", *volume(), study, in_scanner_space=True)
    found = {path.name for path in (tmp_path / "out").iterdir()}
    assert found == {f"{k + 1:04d}.dcm" for k in range(5)} | {"lost+found"}


def test_geometry_and_values_are_read_back(study: SourceStudy, tmp_path: Path) -> None:
    data, affine = volume()
    write_volume_series(tmp_path / "out", data, affine, study, in_scanner_space=True)
    images = read(tmp_path / "out")
    assert [path.name for path in sorted((tmp_path / "out").iterdir())] == [f"{k + 1:04d}.dcm" for k in range(5)]
    first, last = images[0], images[-1]
    row, column = np.array(first.ImageOrientationPatient, float).reshape(2, 3)
    row_step, column_step = np.array(first.PixelSpacing, float)  # between rows, between columns
    lps = np.eye(4)
    lps[:3, 0], lps[:3, 1] = row * column_step, column * row_step
    lps[:3, 3] = np.array(first.ImagePositionPatient, float)
    lps[:3, 2] = (np.array(last.ImagePositionPatient, float) - lps[:3, 3]) / (len(images) - 1)
    np.testing.assert_allclose(np.linalg.norm(lps[:3, 2]), float(first.SpacingBetweenSlices), rtol=1e-9)
    assert np.cross(row, column) @ lps[:3, 2] > 0
    assert row[0] > 0.8  # to the patient's left
    assert column[1] > 0.8  # to the back
    slope, intercept = float(first.RescaleSlope), float(first.RescaleIntercept)
    values = np.stack([one.pixel_array.T * slope + intercept for one in images], axis=-1)
    index = np.stack(np.meshgrid(*map(np.arange, values.shape), indexing="ij"), -1).reshape(-1, 3)
    world = (LPS_FROM_RAS @ lps @ np.c_[index, np.ones(len(index))].T)[:3]
    meant = np.linalg.inv(affine) @ np.vstack([world, np.ones(world.shape[1])])
    there = np.rint(meant[:3]).astype(int)
    assert np.abs((affine @ meant - affine @ np.vstack([there, np.ones(there.shape[1])]))[:3]).max() < 1e-3
    assert np.abs(values.ravel() - data[tuple(there)]).max() <= slope / 2 * (1 + 1e-6)
    assert slope < (data.max() - min(data.min(), 0)) / 65534


@pytest.mark.parametrize("value", [0.0, 7.0, -7.0])
def test_a_constant_volume(value: float, study: SourceStudy, tmp_path: Path) -> None:
    write_volume_series(
        tmp_path / "out", np.full((3, 3, 3), value, np.float32), np.eye(4), study, in_scanner_space=True
    )
    for one in read(tmp_path / "out"):
        values = one.pixel_array * float(one.RescaleSlope) + float(one.RescaleIntercept)
        np.testing.assert_allclose(values, value, atol=1e-6)


def test_another_program_reads_the_same_volume(study: SourceStudy, tmp_path: Path) -> None:
    data, affine = volume()
    write_volume_series(tmp_path / "out", data, affine, study, in_scanner_space=True)
    words = [converter(), "-z", "n", "-f", "volume", "-o", str(tmp_path), str(tmp_path / "out")]
    subprocess.run(words, check=True, capture_output=True)
    image = nib.Nifti1Image.from_filename(tmp_path / "volume.nii")
    index = np.stack(np.meshgrid(*map(np.arange, image.shape), indexing="ij"), -1).reshape(-1, 3)
    there = (np.linalg.inv(affine) @ image.affine @ np.c_[index, np.ones(len(index))].T)[:3]
    assert np.abs(there - np.rint(there)).max() < 1e-3
    values = np.asarray(image.dataobj).ravel()
    np.testing.assert_allclose(values, data[tuple(np.rint(there).astype(int))], atol=0.02)


def test_flags_and_references(study: SourceStudy, tmp_path: Path) -> None:
    write_volume_series(tmp_path / "out", *volume(), study, in_scanner_space=True)
    images, sources = read(tmp_path / "out"), study.images
    assert len({one.SOPInstanceUID for one in images}) == len(images)
    assert len({one.SeriesInstanceUID for one in images} - {one.series_uid for one in sources}) == 1
    for k, one in enumerate(images):
        assert one.SOPClassUID == pydicom.uid.MRImageStorage
        assert one.file_meta.MediaStorageSOPInstanceUID == one.SOPInstanceUID
        assert one.StudyInstanceUID == sources[0].study_uid
        assert list(one.ImageType[:2]) == ["DERIVED", "SECONDARY"]
        assert one.SeriesDescription == DESCRIPTION == "g3r reconstruction, derived, not for diagnosis"
        assert "not for diagnosis" in one.DerivationDescription
        assert one.SeriesNumber == 9002  # 9001 is taken
        assert one.InstanceNumber == k + 1
        uids = {one.sop_uid for one in sources}
        assert {item.ReferencedSOPInstanceUID for item in one.SourceImageSequence} == uids
        by_series = {item.SeriesInstanceUID: item.ReferencedInstanceSequence for item in one.ReferencedSeriesSequence}
        assert set(by_series) == {one.series_uid for one in sources}
        assert {item.ReferencedSOPInstanceUID for items in by_series.values() for item in items} == uids


def test_the_frame_of_reference(study: SourceStudy, tmp_path: Path) -> None:
    """In scanner space it is that of the source; in standard orientation positions have another meaning."""
    found = []
    for name, in_scanner_space in (("scanner", True), ("standard", False)):
        write_volume_series(tmp_path / name, *volume(), study, in_scanner_space=in_scanner_space)
        (frame,) = {one.FrameOfReferenceUID for one in read(tmp_path / name)}
        found.append(frame)
    assert found[0] == study.frame_uid
    assert found[1] != study.frame_uid
    moved = SourceStudy(study.identity, (*study.images[:1], *read_moved(tmp_path)))
    assert moved.frame_uid is None
    write_volume_series(tmp_path / "moved", *volume(), moved, in_scanner_space=True)
    assert read(tmp_path / "moved")[0].FrameOfReferenceUID not in {one.frame_uid for one in moved.images}


def read_moved(folder: Path) -> tuple[Any, ...]:
    """Images of a patient who left the scanner in between."""
    (folder / "second").mkdir()
    Study(folder / "second").write(*block(), 5)
    return tuple(read_images(folder / "second").images)


def test_it_repeats_the_patient_and_the_study_and_nothing_else(study: SourceStudy, tmp_path: Path) -> None:
    write_volume_series(tmp_path / "out", *volume(), study, in_scanner_space=True)
    one = read(tmp_path / "out")[0]
    assert {name for name in KEPT if str(one[name].value) != PERSONAL[name]} == set()
    assert {name for name in PERSONAL if name in one} - OURS == KEPT
    assert not {name for name in OURS if str(one[name].value) == PERSONAL[name]}


def test_names_keep_their_letters(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    personal = {"SpecificCharacterSet": "ISO_IR 100", "PatientName": "Åsa^Müller"}
    Study(tmp_path / "source", personal).write(*block(), 3)
    write_volume_series(tmp_path / "out", *volume(), read_study(tmp_path / "source"), in_scanner_space=True)
    one = read(tmp_path / "out")[0]
    assert one.PatientName == "Åsa^Müller"
    assert one.AccessionNumber == one.StudyID == ""  # required attributes that may be empty


def test_it_is_whole_or_not_at_all(study: SourceStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved = pydicom.Dataset.save_as
    n_written = []

    def full_disk(self: Any, path: Path, **options: Any) -> None:
        n_written.append(path)
        if len(n_written) == 3:
            raise OSError(28, "No space left on device")
        saved(self, path, **options)

    monkeypatch.setattr(pydicom.Dataset, "save_as", full_disk)
    before = set(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"out: cannot be written \(No space left on device\); the other results"):
        write_volume_series(tmp_path / "out", *volume(), study, in_scanner_space=True)
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize("kind", ["not empty", "a file", "below a file", "a link to nothing"])
def test_a_folder_that_cannot_be_written_is_refused(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    if kind == "not empty":
        folder.mkdir()
        (folder / "mine").write_text("mine")
    elif kind == "a link to nothing":
        folder.symlink_to(tmp_path / "nothing")
    else:
        folder.write_text("mine")
    with pytest.raises(InputError, match="choose another --dicom-out"):
        check_new_folder(folder / "deep" if kind == "below a file" else folder)


def test_an_empty_folder_will_do(study: SourceStudy, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_volume_series(tmp_path / "out", *volume(), study, in_scanner_space=True)
    assert len(read(tmp_path / "out")) == 5


def test_a_reference_of_two_examinations_is_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        Study(tmp_path / name).write(*block(), 3)
    with pytest.raises(InputError, match="holds 2 examinations; expected the one that the volume is to join"):
        read_study(tmp_path)
