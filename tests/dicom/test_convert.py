"""Conversion of series to NIfTI: correct geometry, and no information about the patient."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.sidecar import read_sidecar
from g3r.dicom import convert as convert_module
from g3r.dicom.convert import KEPT_KEYS, convert, converter_version
from g3r.dicom.headers import read_images
from g3r.dicom.private_folder import PREFIX, private_folder
from g3r.dicom.series import Series, grouped
from g3r.errors import InputError
from g3r.run.process_mark import process_mark
from tests.dicom.conftest import STACKS, THICKNESS_MM, Examination, block, second_axis_flipped
from tests.dicom.dicom_files import TRACES, Study

CORNERS = np.array([[i, j, k, 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)]).T


def series_of(folder: Path) -> dict[str, Series]:
    return {series.label: series for series in grouped(read_images(folder).images)}


def test_stacks_are_where_the_nifti_files_put_them(examination: Examination, tmp_path: Path) -> None:
    """Affines agree within 1e-3 mm, voxels and thickness exactly, and no names occur."""
    series = series_of(examination.dicom)
    for number, source in zip(STACKS, examination.stacks, strict=True):
        path = convert(series[str(number)], tmp_path)
        assert path.name == f"series-{number}.nii"
        made, meant = nib.Nifti1Image.from_filename(path), nib.Nifti1Image.from_filename(source)
        data, affine = second_axis_flipped(np.asarray(meant.dataobj), meant.affine)
        np.testing.assert_array_equal(np.asarray(made.dataobj), data)
        corners = CORNERS * np.array([*(n - 1 for n in data.shape), 1])[:, None]
        assert np.abs(made.affine @ corners - affine @ corners).max() < 1e-3
        sidecar = read_sidecar(path.with_suffix(".json"))
        assert sidecar is not None
        assert sidecar.thickness_mm == THICKNESS_MM
        assert set(json.loads(path.with_suffix(".json").read_text())) <= set(KEPT_KEYS)
    assert {path.name for path in tmp_path.iterdir()} == {
        f"series-{n}.{end}" for n in STACKS for end in ("nii", "json")
    }
    for path in tmp_path.iterdir():
        assert not [word for word in TRACES if word in path.read_bytes()], path


def test_the_same_images_give_the_same_bytes(examination: Examination, tmp_path: Path) -> None:
    series = series_of(examination.dicom)["3"]
    made = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        made.append(convert(series, tmp_path / name).read_bytes())
    assert made[0] == made[1]


def test_phase_encoding_reaches_the_sidecar(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    Study(tmp_path).write(*block(), 2, InPlanePhaseEncodingDirection="COL", PercentPhaseFieldOfView=75)
    path = convert(series_of(tmp_path)["2"], tmp_path / "out")
    assert json.loads(path.with_suffix(".json").read_text())["InPlanePhaseEncodingDirectionDICOM"] == "COL"


def test_a_thickness_of_zero_is_none(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    Study(tmp_path).write(*block(), 2, thickness_mm=0)
    path = convert(series_of(tmp_path)["2"], tmp_path / "out")
    assert "SliceThickness" not in json.loads(path.with_suffix(".json").read_text())


def test_names_with_spaces_and_odd_letters(tmp_path: Path) -> None:
    folder = tmp_path / "a 'b' ü"
    folder.mkdir()
    Study(folder).write(*block(), 2)
    assert convert(series_of(folder)["2"], tmp_path).is_file()


def test_what_dcm2niix_cannot_read_is_refused(tmp_path: Path) -> None:
    """A truncated file, which the choice of series would name; here it is truncated afterwards."""
    paths = Study(tmp_path).write(*block(), 2)
    series = series_of(tmp_path)["2"]
    paths[3].write_bytes(paths[3].read_bytes()[:-100])
    with pytest.raises(
        InputError, match=r"series-2: dcm2niix did not make a stack of it \(exit code 1\); leave it out"
    ):
        convert(series, tmp_path)


def test_slices_that_were_lost_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link_all_but_the_last(source: Path, target: Path) -> None:
        if target.name != "00008.dcm":
            target.symlink_to(source)

    monkeypatch.setattr(convert_module, "_link", link_all_but_the_last)
    Study(tmp_path).write(*block(9), 3)
    with pytest.raises(InputError, match=r"series-3: dcm2niix made 10 x 12 x 8 voxels of it, 4 mm apart; expected 9"):
        convert(series_of(tmp_path)["3"], tmp_path)


def test_the_version_is_known() -> None:
    assert converter_version().startswith("v1.0.")


def test_a_converter_of_the_system_will_do(monkeypatch: pytest.MonkeyPatch) -> None:
    import dcm2niix

    monkeypatch.setenv("PATH", str(Path(dcm2niix.bin).parent))
    monkeypatch.setitem(sys.modules, "dcm2niix", None)
    assert converter_version().startswith("v1.0.")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ModuleNotFoundError):
        convert_module.converter()


def interrupted_in_the_folder() -> None:
    with private_folder() as folder:
        assert folder.stat().st_mode & 0o777 == 0o700
        (folder / "series-1.nii").write_text("image")
        raise KeyboardInterrupt


def test_the_folder_is_private_and_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    place, own = process_mark().split("-")
    marks = (f"{place}-{ended.pid}", f"{place}-{own}", f"00000000-{ended.pid}")
    dead, alive, elsewhere = (tmp_path / f"{PREFIX}{mark}-x" for mark in marks)
    for folder in (dead, alive, elsewhere):
        folder.mkdir()
        (folder / "series-1.nii").write_text("left")
    with pytest.raises(KeyboardInterrupt):
        interrupted_in_the_folder()
    # a process of another machine may still be running, whatever its id means here
    assert set(tmp_path.iterdir()) == {alive, elsewhere}


def test_a_converter_that_cannot_be_started_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "dcm2niix"
    broken.write_text("of another machine")
    monkeypatch.setattr(convert_module, "converter", lambda: str(broken))
    with pytest.raises(InputError, match=r"dcm2niix cannot be started .*reinstall it"):
        converter_version()
