"""NIfTI volumes and masks: scaling, grids, writing, and every refusal."""

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from nibabel.arrayproxy import ArrayProxy

from g3r.acquisition.images import Volume, load_mask, load_volume, save_volume
from g3r.acquisition.nifti import MAX_VOXEL_COUNT
from g3r.errors import InputError
from tests.acquisition.nifti_files import AXES, affine_of, arrays, write


def test_int16_with_slope_and_intercept(tmp_path: Path) -> None:
    raw = np.random.default_rng(1).integers(0, 4000, (8, 9, 5)).astype(np.int16)
    image = nib.Nifti1Image(raw, affine_of(AXES["LAS"]))
    image.header.set_slope_inter(0.25, -3.0)
    nib.save(image, tmp_path / "a.nii.gz")
    # nibabel scales values on writing, so the raw numbers are read
    stored = nib.Nifti1Image.from_filename(tmp_path / "a.nii.gz")
    assert stored.get_data_dtype() == np.int16
    assert isinstance(stored.dataobj, ArrayProxy)
    expected = np.asarray(stored.dataobj.get_unscaled()) * stored.dataobj.slope + stored.dataobj.inter
    loaded = load_volume(tmp_path / "a.nii.gz")
    assert loaded.data.dtype == np.float32
    assert (stored.dataobj.slope, stored.dataobj.inter) != (1.0, 0.0)
    np.testing.assert_allclose(loaded.data, expected, rtol=1e-6, atol=1e-3)


def test_mask_whose_header_lost_digits_is_accepted(tmp_path: Path) -> None:
    image, mask = arrays()
    affine = affine_of(AXES["oblique"])
    shifted = affine.copy()
    shifted[:3, 3] += affine[:3, 0] * 0.3
    reference = load_volume(write(tmp_path / "a.nii.gz", image, affine))
    found = load_mask(write(tmp_path / "m.nii.gz", mask.astype(np.float32), np.round(shifted, 3)), reference)
    np.testing.assert_array_equal(found, mask)


@pytest.mark.parametrize("change", ["shift", "flip", "shape"])
def test_mask_of_another_grid_is_refused(tmp_path: Path, change: str) -> None:
    image, mask = arrays()
    affine = affine_of(AXES["RAS"])
    other = affine.copy()
    if change == "shift":
        other[:3, 3] += affine[:3, 2] * 0.6
    elif change == "flip":
        other[:3, 0] *= -1
    else:
        mask = mask[:-1]
    reference = load_volume(write(tmp_path / "a.nii.gz", image, affine))
    path = write(tmp_path / "m.nii.gz", mask.astype(np.uint8), other)
    with pytest.raises(InputError, match=r"m\.nii\.gz: mask .*a\.nii\.gz.*resample the mask"):
        load_mask(path, reference)


def test_save_and_load_volume(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    affine = affine_of(AXES["oblique left-handed"])
    for data, kind in (
        (rng.normal(size=(4, 5, 6)), np.float32),
        (rng.normal(size=(4, 5, 6)) > 0, np.uint8),
        (rng.integers(-5, 5, (4, 5, 6)).astype(np.int16), np.int16),
    ):
        save_volume(tmp_path / "v.nii.gz", data, affine)
        assert nib.Nifti1Image.from_filename(tmp_path / "v.nii.gz").get_data_dtype() == kind
        back = load_volume(tmp_path / "v.nii.gz")
        np.testing.assert_allclose(back.data, data.astype(np.float32), rtol=1e-7)
        np.testing.assert_allclose(back.affine, affine, atol=1e-5)
    assert [path.name for path in tmp_path.iterdir()] == ["v.nii.gz"]


def test_save_volume_into_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        save_volume(tmp_path / "no" / "v.nii.gz", np.zeros((2, 2, 2)), np.eye(4))


def bad_files(folder: Path) -> dict[str, Path]:
    """One file per kind of unusable input."""
    image, _ = arrays()
    affine = affine_of(AXES["RAS"])
    files = {name: folder / f"{name}.nii.gz" for name in ("missing", "text", "frames", "complex", "colour", "singular")}
    files["text"].write_text("not an image\n")
    write(files["frames"], np.zeros((4, 4, 4, 3), np.float32), affine)
    write(files["complex"], np.ones((4, 4, 4), np.complex64), affine)
    write(files["colour"], np.zeros((4, 4, 4), [("R", "u1"), ("G", "u1"), ("B", "u1")]), affine)
    header = nib.Nifti1Header()
    header.set_data_shape((4, 4, 4))
    header.set_data_dtype(np.float32)
    singular = nib.Nifti1Image(np.zeros((4, 4, 4), np.float32), None, header)
    singular.header["sform_code"], singular.header["qform_code"] = 1, 0
    singular.header["srow_x"], singular.header["srow_y"] = (1, 0, 0, 0), (1, 0, 0, 0)
    singular.header["srow_z"] = (0, 0, 1, 0)
    files["singular"].write_bytes(b"")
    raw = folder / "singular.nii"
    raw.write_bytes(singular.header.binaryblock + b"\0" * 4 + np.zeros(64, np.float32).tobytes())
    files["singular"] = raw
    files["folder"] = folder / "folder.nii.gz"
    files["folder"].mkdir()
    whole = write(folder / "whole.nii.gz", np.random.default_rng(0).normal(size=image.shape), affine).read_bytes()
    files["cut off"] = folder / "cut.nii.gz"
    files["cut off"].write_bytes(whole[: len(whole) // 2])
    files["cut header"] = folder / "cuthead.nii.gz"
    files["cut header"].write_bytes(whole[:40])
    files["empty"] = folder / "empty.nii.gz"
    files["empty"].write_bytes(b"")
    huge = nib.Nifti1Header()
    huge.set_data_shape((2000, 2000, 2000))
    huge.set_data_dtype(np.float32)
    files["huge"] = folder / "huge.nii"
    files["huge"].write_bytes(huge.binaryblock + b"\0" * 4)
    files["other format"] = folder / "other.mgz"
    nib.save(nib.MGHImage(image, affine), files["other format"])
    return files


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "no such file"),
        ("folder", "is a folder"),
        ("text", "not a readable NIfTI"),
        ("empty", "not a readable NIfTI"),
        ("cut header", "not a readable NIfTI"),
        ("cut off", "cannot be read.*cut off"),
        ("frames", "expected 3D"),
        ("complex", "complex"),
        ("colour", "colour"),
        ("singular", "bad header.*singular"),
        ("huge", "header claims"),
        ("other format", "not NIfTI by its name; expected .nii"),
    ],
)
def test_unusable_files_are_refused_in_one_line_that_names_them(tmp_path: Path, kind: str, message: str) -> None:
    path = bad_files(tmp_path)[kind]
    with pytest.raises(InputError, match=message) as caught:
        load_volume(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 3
    assert MAX_VOXEL_COUNT < 2000**3


def test_an_empty_mask_is_refused(tmp_path: Path) -> None:
    image, mask = arrays()
    reference = Volume(image, affine_of(AXES["RAS"]), "a")
    path = write(tmp_path / "m.nii.gz", np.zeros(mask.shape, np.uint8), reference.affine)
    with pytest.raises(InputError, match=r"m\.nii\.gz: mask is empty"):
        load_mask(path, reference)


@pytest.mark.parametrize("top", [100, 255])
def test_a_probability_in_whole_numbers_is_cut_at_its_half(tmp_path: Path, top: int) -> None:
    image, _ = arrays()
    reference = load_volume(write(tmp_path / "a.nii.gz", image, np.eye(4)))
    place = np.linspace(-8, 4, image.size).reshape(image.shape)
    probability = 1 / (1 + np.exp(-4 * place))
    scaled = np.rint(np.where(place > 1.5, 1, probability) * top).astype(np.uint8)
    found = load_mask(write(tmp_path / "m.nii.gz", scaled, np.eye(4)), reference)
    np.testing.assert_array_equal(found, scaled > top / 2)
    # labels that reach the same number are brain from 1 on
    labels = np.where(place > 0, 1 + np.arange(image.size).reshape(image.shape) % 60, 0).astype(np.uint8)
    labels.ravel()[-1] = top
    np.testing.assert_array_equal(load_mask(write(tmp_path / "l.nii.gz", labels, np.eye(4)), reference), labels > 0)
