"""Choice of series of an examination, and the reasons for the others."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g3r.dicom.choice import Judged, check_one_examination, judged
from g3r.dicom.headers import read_images
from g3r.dicom.series import grouped
from g3r.dicom.table import HIDDEN, table_of
from g3r.errors import InputError
from tests.dicom.conftest import Examination, block
from tests.dicom.dicom_files import CANARY, Study, pydicom


def verdicts(folder: Path, *asked_for: str) -> dict[str, Judged]:
    return {one.series.label: one for one in judged(grouped(read_images(folder).images), asked_for or None)}


def test_the_stacks_are_taken_and_nothing_else(examination: Examination) -> None:
    found = verdicts(examination.dicom)
    assert {label: (one.is_taken, one.reason) for label, one in found.items()} == {
        "1": (False, "localiser"),
        "3": (True, ""),
        "4": (True, ""),
        "5": (False, "derived"),
        "6": (False, "3D acquisition"),
        "7": (True, ""),
        "8": (False, "fewer than 8 slices"),
        # instance numbers run over every second slice first, from slice 1: slice 7 of 12 is the fourth of them
        "9": (False, "slice 7 of 12 is missing (image number 4)"),
        "10": (False, "echo-planar"),
    }
    assert [label for label, one in found.items() if one.is_broken] == ["9"]


def test_the_table(examination: Examination) -> None:
    found = list(verdicts(examination.dicom).values())
    lines = table_of(found, descriptions=True).splitlines()
    assert lines[0].split() == ["series", "description", "plane", "slices", "thickness", "+", "gap,", "mm", "taken"]
    assert lines[1].split() == ["1", "t2_haste_loc", "axial", "12", "7", "-", "3", "no:", "localiser"]
    assert lines[2].split() == ["3", "DOE", "SERIES", "axial,", "14°", "off", "17", "3.2", "+", "0.8", "yes"]
    hidden = table_of(found, descriptions=False)
    assert "DOE" not in hidden
    assert hidden.endswith(HIDDEN)


def test_a_description_does_not_steer_the_terminal(tmp_path: Path) -> None:
    Study(tmp_path).write(*block(), 1, SeriesDescription="\x1b[2Jt2\nhaste")
    assert "?[2Jt2?haste" in table_of(list(verdicts(tmp_path).values()), descriptions=True)


@pytest.mark.parametrize(
    ("tags", "reason"),
    [
        ({}, ""),
        ({"ImageType": ["ORIGINAL", "PRIMARY"]}, ""),
        ({"SeriesDescription": "location of placenta"}, ""),
        ({"ImageType": ["ORIGINAL", "SECONDARY"]}, "derived"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "LOCALIZER"]}, "localiser"),
        ({"SeriesDescription": "SCOUT_3plane"}, "localiser"),
        ({"ProtocolName": "Survey"}, "localiser"),
        ({"Modality": "CT"}, "not MR but CT"),
        ({"ScanningSequence": ["SE", "IR"]}, "inversion recovery"),
        ({"ScanningSequence": "GR"}, "gradient echo"),
        ({"ScanningSequence": ""}, "does not say which sequence it is of"),
        ({"EchoTime": 12}, "not T2-weighted (TE 12 ms)"),
        ({"EchoTime": None}, "does not say its echo time"),
        ({"ImageType": None}, "does not say whether it is original"),
        ({"NumberOfFrames": 2}, "multi-frame images"),
        ({"ImagePositionPatient": None}, "its images do not say where they are"),
        ({"ImageOrientationPatient": [1, 0, 0, 0, float("nan"), 0]}, "its images do not say where they are"),
    ],
    ids=str,
)
def test_the_rules(tags: dict[str, Any], reason: str, tmp_path: Path) -> None:
    Study(tmp_path).write(*block(), 2, **tags)
    found = verdicts(tmp_path)["2"]
    assert found.is_taken == (not reason)
    assert found.reason.startswith(reason)


def test_an_acquisition_that_is_stored_twice_counts_once(tmp_path: Path) -> None:
    study = Study(tmp_path)
    for number, kind in ((2, "ND"), (3, "DIS2D")):
        study.write(*block(), number, ImageType=["ORIGINAL", "PRIMARY", "M", kind], AcquisitionTime="081500.5")
    study.write(*block(), 4, AcquisitionTime="082000")
    found = verdicts(tmp_path)
    assert [one.is_taken for one in found.values()] == [False, True, True]
    assert found["2"].reason == "same acquisition as series 3"


def test_stacks_whose_times_were_removed_are_no_copies(tmp_path: Path) -> None:
    study = Study(tmp_path)
    data, affine = block()
    for number, axes in ((2, [0, 1, 2, 3]), (3, [1, 2, 0, 3]), (4, [0, 1, 2, 3])):
        study.write(data, affine[:, axes], number, AcquisitionTime="000000")
    assert [one.is_taken for one in verdicts(tmp_path).values()] == [True, True, True]


def test_two_series_of_one_number_have_letters(tmp_path: Path) -> None:
    study = Study(tmp_path)
    for time in ("090000", "080000"):
        study.write(*block(), 2, AcquisitionTime=time)
    found = verdicts(tmp_path)
    assert list(found) == ["2a", "2b"]
    assert found["2a"].series.first.acquired_at == "080000"
    with pytest.raises(InputError, match="--series 2: several series have this number, choose from 2a, 2b"):
        verdicts(tmp_path, "2")


def test_a_copied_file_counts_once(tmp_path: Path) -> None:
    for path in Study(tmp_path).write(*block(), 2):
        path.with_name(f"copy-{path.name}").write_bytes(path.read_bytes())
    assert verdicts(tmp_path)["2"].series.n_images == 12


def test_who_is_asked_for_is_taken(examination: Examination) -> None:
    found = verdicts(examination.dicom, "7", "1")
    assert [label for label, one in found.items() if one.is_taken] == ["1", "7"]
    assert found["3"].reason == "not asked for"


@pytest.mark.parametrize(
    ("label", "says"),
    [
        ("2", "--series 2: is not there; the folder has series 1, 3, 4, 5, 6, 7, 8, 9, 10"),
        ("9", "--series 9: slice 7 of 12 is missing (image number 4); leave it out, or export the series again"),
    ],
)
def test_what_cannot_be_taken_is_refused(examination: Examination, label: str, says: str) -> None:
    with pytest.raises(InputError) as caught:
        verdicts(examination.dicom, label)
    assert str(caught.value) == says


@pytest.mark.parametrize(
    ("missing", "says"),
    [
        ([3, 4, 8], "slices 4, 5, 9 of 12 are missing (image number 3, 5, 8)"),
        ([11], None),  # a missing last slice cannot be detected
    ],
)
def test_missing_slices_are_named(missing: list[int], says: str | None, tmp_path: Path) -> None:
    Study(tmp_path).write(*block(), 2, missing=missing)
    assert verdicts(tmp_path)["2"].series.missing() == says


def test_many_missing_slices_are_counted(tmp_path: Path) -> None:
    Study(tmp_path).write(*block(40), 2, missing=range(4, 30))
    assert verdicts(tmp_path)["2"].reason == "26 of 40 slices are missing"


def test_images_of_several_sizes_are_no_stack(tmp_path: Path) -> None:
    paths = Study(tmp_path).write(*block(), 2)
    header = pydicom.dcmread(paths[0])
    header.Rows, header.Columns = header.Columns, header.Rows
    header.save_as(paths[0])
    assert verdicts(tmp_path)["2"].reason == "its images have several sizes"


def test_damaged_headers_raise_nothing_else(tmp_path: Path) -> None:
    """With random changes of header bytes, a series is listed in some way, or the folder is refused."""
    paths = Study(tmp_path).write(*block(), 2)
    whole = [path.read_bytes() for path in paths]
    rng = np.random.default_rng(7)
    for _ in range(60):
        for path, content in zip(paths, whole, strict=True):
            changed = bytearray(content)
            for place in rng.integers(132, len(content), rng.integers(0, 4)):
                changed[place] = rng.integers(256)
            path.write_bytes(changed)
        with suppress(InputError):
            table_of(list(verdicts(tmp_path).values()), descriptions=True)


def test_uneven_slices_are_refused(tmp_path: Path) -> None:
    paths = Study(tmp_path).write(*block(), 2)
    header = pydicom.dcmread(paths[0])
    header.ImagePositionPatient = [0, 0, -1]
    header.save_as(paths[0])
    assert verdicts(tmp_path)["2"].reason == "slices are 4 to 5 mm apart"


def test_a_file_that_is_cut_off_is_named(tmp_path: Path) -> None:
    paths = Study(tmp_path).write(*block(), 2)
    paths[3].write_bytes(paths[3].read_bytes()[:-300])
    paths[5].write_bytes(paths[5].read_bytes()[:140])
    below = read_images(tmp_path)
    (found,) = judged(grouped(below.images))
    assert (below.n_damaged, below.n_unreadable) == (1, 0)
    assert found.reason == "the file of image number 4 is cut off"


def test_several_patients_or_examinations_are_refused(tmp_path: Path) -> None:
    for n, personal in enumerate(({"PatientID": CANARY}, {"PatientID": f"{CANARY}2"})):
        (tmp_path / str(n)).mkdir()
        Study(tmp_path / str(n), personal).write(*block(), 2)
    series = [one.series for one in verdicts(tmp_path).values()]
    with pytest.raises(InputError, match="its T2-weighted series are of 2 patients; expected one") as caught:
        check_one_examination(series, "folder")
    assert CANARY not in str(caught.value)
    check_one_examination(series[:1], "folder")


@pytest.mark.parametrize("kind", ["nothing", "file", "empty", "no DICOM", "no image"])
def test_a_folder_without_images_is_refused(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    if kind == "file":
        folder.write_text("text")
    elif kind != "nothing":
        folder.mkdir()
    if kind == "no DICOM":
        np.save(folder / "array.npy", np.zeros(100))
    elif kind == "no image":
        for path in Study(folder).write(*block(), 2):
            path.write_bytes(path.read_bytes()[:140])
    with pytest.raises(InputError, match=r"expected .*folder"):
        read_images(folder)
