"""From NIfTI headers to pixels in space: poses, axes, masks, scaling, and every refusal."""

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.images import Volume, load_mask, load_volume, save_volume
from g3r.acquisition.nifti import MAX_VOXEL_COUNT
from g3r.acquisition.planes import Planes, volume_from_pixels, volume_planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid

AXES = {
    "RAS": np.eye(3),
    "LAS": np.diag([-1.0, 1, 1]),
    "LPS": np.diag([-1.0, -1, 1]),
    "LPI": -np.eye(3),
    "coronal": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "oblique": Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(),
    "oblique left-handed": Rotation.from_rotvec([1.3, 0.5, -0.9]).as_matrix() @ np.diag([1.0, 1, -1]),
}


def affine_of(axes: np.ndarray, spacing=(0.8, 0.9, 3.0), origin=(-20.0, 31.0, 7.5)) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = axes * np.array(spacing)
    affine[:3, 3] = origin
    return affine


def arrays(seed: int = 0, shape=(14, 11, 6)) -> tuple[np.ndarray, np.ndarray]:
    """Distinct values, so that a value tells its voxel, and a ragged mask off the middle."""
    rng = np.random.default_rng(seed)
    image = (1 + rng.permutation(np.prod(shape))).reshape(shape).astype(np.float32)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
    mask = (((index - np.array(shape) * [0.6, 0.4, 0.45]) / (np.array(shape) * 0.45)) ** 2).sum(-1) < 1
    return image, mask


def write(path: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    nib.save(nib.Nifti1Image(data, affine), path)
    return path


def assert_pixels_are_voxels(slices, image, affine, n_masked):
    """Every masked pixel of the slices: position and value are those of the voxel it was cut from."""
    world = slices.planes.pixel_world_mm(slices.pixel_index)
    assert len(world) == n_masked
    index = (np.linalg.inv(affine) @ np.c_[world, np.ones(len(world))].T)[:3].T
    nearest = np.rint(index).astype(int)
    by_affine = (affine @ np.c_[nearest, np.ones(len(world))].T)[:3].T
    np.testing.assert_allclose(world, by_affine, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(slices.masked_value, image[tuple(nearest.T)])


@pytest.mark.parametrize("name", AXES)
def test_pixels_lie_where_the_header_says(tmp_path: Path, name: str):
    image, mask = arrays()
    affine = affine_of(AXES[name])
    stack = load_stack(
        write(tmp_path / "a.nii.gz", image, affine), write(tmp_path / "m.nii.gz", mask.astype(np.uint8), affine), 2.5
    )
    kept = mask.sum((0, 1)) >= 12
    slices = slices_from_stacks([stack])
    stored = nib.load(tmp_path / "a.nii.gz").affine  # float32 in the file
    assert_pixels_are_voxels(slices, image, stored, mask[:, :, kept].sum())
    assert slices.slice_index.tolist() == np.flatnonzero(kept).tolist()
    np.testing.assert_allclose(np.linalg.det(slices.planes.rotation), 1, atol=1e-12)
    np.testing.assert_allclose(slices.world_from_header().translation_mm, 0, atol=1e-12)
    np.testing.assert_allclose(slices.planes.psf_var_mm2[0], psf_variance_mm2([0.8, 0.9], 2.5), rtol=1e-6)


@pytest.mark.parametrize("through", [0, 1, 2])
def test_slices_on_any_axis_are_found_by_their_distance(tmp_path: Path, through: int):
    image, mask = arrays()
    order = [0, 1]
    order.insert(through, 2)  # file axis `through` is the third axis of the image
    spacing = np.array([0.8, 0.9, 3.0])[order]
    affine = affine_of(AXES["oblique"], spacing)
    path = write(tmp_path / "a.nii.gz", image.transpose(order), affine)
    mask_path = write(tmp_path / "m.nii.gz", mask.transpose(order).astype(np.uint8), affine)
    stack = load_stack(path, mask_path)
    assert stack.image.shape == image.shape
    np.testing.assert_allclose(stack.spacing_mm, [0.8, 0.9, 3.0], rtol=1e-6)
    slices = slices_from_stacks([stack])
    kept = mask.sum((0, 1)) >= 12
    stored = nib.load(path).affine
    assert_pixels_are_voxels(slices, image.transpose(order), stored, mask[:, :, kept].sum())
    assert slices.slice_index.tolist() == np.flatnonzero(kept).tolist()


def test_four_dimensions_with_one_frame(tmp_path: Path):
    image, mask = arrays()
    path = write(tmp_path / "a.nii.gz", image[..., None], affine_of(AXES["RAS"]))
    mask_path = write(tmp_path / "m.nii.gz", mask[..., None].astype(np.uint8), affine_of(AXES["RAS"]))
    stack = load_stack(path, mask_path)
    np.testing.assert_array_equal(stack.image, image)
    np.testing.assert_array_equal(stack.mask, mask)


def test_int16_with_slope_and_intercept(tmp_path: Path):
    raw = np.random.default_rng(1).integers(0, 4000, (8, 9, 5)).astype(np.int16)
    image = nib.Nifti1Image(raw, affine_of(AXES["LAS"]))
    image.header.set_slope_inter(0.25, -3.0)
    nib.save(image, tmp_path / "a.nii.gz")
    # nibabel stores what was given after scaling; read the raw numbers to know what the file says
    stored = nib.load(tmp_path / "a.nii.gz")
    assert stored.get_data_dtype() == np.int16
    expected = np.asarray(stored.dataobj.get_unscaled()) * stored.dataobj.slope + stored.dataobj.inter
    loaded = load_volume(tmp_path / "a.nii.gz")
    assert loaded.data.dtype == np.float32
    assert (stored.dataobj.slope, stored.dataobj.inter) != (1.0, 0.0)
    np.testing.assert_allclose(loaded.data, expected, rtol=1e-6, atol=1e-3)


def test_mask_whose_header_lost_digits_is_accepted(tmp_path: Path):
    image, mask = arrays()
    affine = affine_of(AXES["oblique"])
    shifted = affine.copy()
    shifted[:3, 3] += affine[:3, 0] * 0.3
    reference = load_volume(write(tmp_path / "a.nii.gz", image, affine))
    found = load_mask(write(tmp_path / "m.nii.gz", mask.astype(np.float32), np.round(shifted, 3)), reference)
    np.testing.assert_array_equal(found, mask)


@pytest.mark.parametrize("change", ["shift", "flip", "shape"])
def test_mask_of_another_grid_is_refused(tmp_path: Path, change: str):
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


def test_thickness_is_not_the_distance_of_slices(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    image, mask = arrays()
    path = write(tmp_path / "a.nii.gz", image, affine_of(AXES["RAS"]))
    mask_path = write(tmp_path / "m.nii.gz", mask.astype(np.uint8), affine_of(AXES["RAS"]))
    with caplog.at_level("INFO"):
        by_header = load_stack(path, mask_path)
    assert by_header.thickness_mm == pytest.approx(3.0)
    assert "thickness" in caplog.text
    given = load_stack(path, mask_path, 2.2)
    assert given.thickness_mm == 2.2
    assert given.spacing_mm[2] == pytest.approx(3.0)
    normal_sigma = np.sqrt(slices_from_stacks([given]).planes.psf_var_mm2[0, 2])
    assert normal_sigma == pytest.approx(2.2 / 2.3548, rel=1e-4)


def test_without_a_mask_positive_voxels_count_and_a_line_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    image, mask = arrays()
    stack = load_stack(write(tmp_path / "a.nii.gz", image * mask, affine_of(AXES["RAS"])))
    np.testing.assert_array_equal(stack.mask, mask)
    assert "no mask" in caplog.text


def test_values_outside_the_mask_may_be_nan(tmp_path: Path):
    image, mask = arrays()
    image[~mask] = np.nan
    stack = Stack(image, mask, affine_of(AXES["RAS"]), 3.0)
    assert np.isfinite(stack.image).all()
    assert np.isfinite(slices_from_stacks([stack]).value).all()


def stacks_of_two() -> list[Stack]:
    return [
        Stack(*arrays(0), affine_of(AXES["RAS"]), 3.0, "first"),
        Stack(*arrays(1, (9, 16, 5)), affine_of(AXES["oblique"]), 2.0, "second"),
    ]


@pytest.mark.parametrize("index", [[3, 0, 7], slice(2, 6), "mask", []])
def test_take_keeps_pixels_values_and_slices_together(index):
    slices = slices_from_stacks(stacks_of_two())
    if index == "mask":
        index = np.arange(len(slices)) % 3 == 1
    chosen = np.arange(len(slices))[index]
    part = slices.take(index)
    assert len(part) == len(chosen)
    np.testing.assert_array_equal(part.stack_id, slices.stack_id[chosen])
    np.testing.assert_array_equal(part.slice_index, slices.slice_index[chosen])
    np.testing.assert_array_equal(part.thickness_mm, slices.thickness_mm[chosen])
    world, offset = slices.planes.pixel_world_mm(), slices.planes.offset
    part_world = part.planes.pixel_world_mm()
    for new, old in enumerate(chosen):
        old_pixels, new_pixels = (slice(offset[old], offset[old + 1]), slice(*part.planes.offset[new : new + 2]))
        np.testing.assert_array_equal(part.value[new_pixels], slices.value[old_pixels])
        np.testing.assert_array_equal(part.mask[new_pixels], slices.mask[old_pixels])
        np.testing.assert_array_equal(part_world[new_pixels], world[old_pixels])
        np.testing.assert_array_equal(part.header_pose.rotation[new], slices.header_pose.rotation[old])


def test_moving_the_world_moves_the_pixels_and_is_reported():
    slices = slices_from_stacks(stacks_of_two())
    motion = RigidPose.from_rotvec([[0.2, -0.1, 0.4]], [[5.0, -3, 2]])
    moved = slices.with_pose(motion @ slices.planes.pose)
    expected = motion.apply(slices.planes.pixel_world_mm()[None])[0]
    np.testing.assert_allclose(moved.planes.pixel_world_mm(), expected, atol=1e-10)
    np.testing.assert_allclose(slices.planes.moved(motion).pixel_world_mm(), expected, atol=1e-10)
    reported = moved.world_from_header()
    np.testing.assert_allclose(reported.rotation, np.tile(motion.rotation, (len(slices), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(reported.translation_mm - motion.translation_mm, 0, atol=1e-10)


def test_slices_with_hardly_a_pixel_are_left_out():
    image, mask = arrays()
    mask[:, :, 2] = False
    mask[5:8, 5:8, 2] = True
    slices = slices_from_stacks([Stack(image, mask, affine_of(AXES["RAS"]), 3.0)])
    assert 2 not in slices.slice_index
    mask[:] = False
    mask[5:8, 5:8] = True
    lonely = Stack(image, mask, affine_of(AXES["RAS"]), 3.0, "lonely")
    with pytest.raises(InputError, match=r"lonely.*12 masked pixels"):
        slices_from_stacks([lonely])


def test_volume_planes_are_the_volume_in_order():
    data = np.random.default_rng(3).normal(size=(5, 4, 3)).astype(np.float32)
    for axes in AXES.values():
        grid = VolumeGrid(data.shape, affine_of(axes))
        planes = volume_planes(grid)
        pixels = data.transpose(2, 0, 1).ravel()
        np.testing.assert_array_equal(volume_from_pixels(pixels, grid), data)
        index = np.stack(np.meshgrid(*[np.arange(n) for n in data.shape], indexing="ij"), -1)
        expected = grid.world(index).transpose(2, 0, 1, 3).reshape(-1, 3)
        np.testing.assert_allclose(planes.pixel_world_mm(), expected, atol=1e-9)
        assert (planes.psf_var_mm2 == 0).all()


def test_save_and_load_volume(tmp_path: Path):
    rng = np.random.default_rng(4)
    affine = affine_of(AXES["oblique left-handed"])
    for data, kind in (
        (rng.normal(size=(4, 5, 6)), np.float32),
        (rng.normal(size=(4, 5, 6)) > 0, np.uint8),
        (rng.integers(-5, 5, (4, 5, 6)).astype(np.int16), np.int16),
    ):
        save_volume(tmp_path / "v.nii.gz", data, affine)
        assert nib.load(tmp_path / "v.nii.gz").get_data_dtype() == kind
        back = load_volume(tmp_path / "v.nii.gz")
        np.testing.assert_allclose(back.data, data.astype(np.float32), rtol=1e-7)
        np.testing.assert_allclose(back.affine, affine, atol=1e-5)
    assert [path.name for path in tmp_path.iterdir()] == ["v.nii.gz"]


def test_save_volume_into_a_missing_folder_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="cannot be written"):
        save_volume(tmp_path / "no" / "v.nii.gz", np.zeros((2, 2, 2)), np.eye(4))


# -- refusals ------------------------------------------------------------------------------------------------


def bad_files(folder: Path) -> dict[str, Path]:
    """One file per way of being unusable."""
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
def test_unusable_files_are_refused_in_one_line_that_names_them(tmp_path: Path, kind: str, message: str):
    path = bad_files(tmp_path)[kind]
    with pytest.raises(InputError, match=message) as caught:
        load_volume(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 3
    assert MAX_VOXEL_COUNT < 2000**3


def test_an_empty_mask_is_refused(tmp_path: Path):
    image, mask = arrays()
    reference = Volume(image, affine_of(AXES["RAS"]), "a")
    path = write(tmp_path / "m.nii.gz", np.zeros(mask.shape, np.uint8), reference.affine)
    with pytest.raises(InputError, match=r"m\.nii\.gz: mask is empty"):
        load_mask(path, reference)


def test_a_stack_without_a_positive_value_and_without_mask_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no positive value"):
        load_stack(write(tmp_path / "a.nii.gz", -arrays()[0], affine_of(AXES["RAS"])))


SHEARED = affine_of(np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((3, 3), np.float32)}, "expected a 3D stack"),
        ({"mask": np.ones((3, 3, 3), bool)}, "mask has shape"),
        ({"image": arrays()[0][:, :, :1], "mask": arrays()[1][:, :, :1]}, "holds 1 slice"),
        ({"affine": np.full((4, 4), np.nan)}, "bad header"),
        ({"affine": np.diag([1.0, 0, 1, 1])}, "bad header.*singular"),
        ({"affine": SHEARED}, "sheared"),
        ({"thickness_mm": 0.0}, "slice thickness 0 mm.*--thickness"),
        ({"thickness_mm": -2.0}, "slice thickness -2 mm"),
        ({"thickness_mm": 50.0}, "slice thickness 50 mm"),
        ({"thickness_mm": float("nan")}, "slice thickness nan"),
        ({"mask": np.zeros((14, 11, 6), bool)}, "mask is empty"),
        ({"image": np.full((14, 11, 6), np.nan, np.float32)}, "not finite"),
        ({"image": np.full((14, 11, 6), np.inf, np.float32)}, "not finite"),
        ({"image": np.full((14, 11, 6), 7, np.float32)}, "every value inside the mask is 7"),
    ],
)
def test_unusable_stacks_are_refused(change, message):
    image, mask = arrays()
    good = {"image": image, "mask": mask, "affine": affine_of(AXES["RAS"]), "thickness_mm": 3.0, "name": "a.nii"}
    Stack(**good)
    with pytest.raises(InputError, match=message) as caught:
        Stack(**(good | change))
    assert str(caught.value).startswith("a.nii: ")


def test_no_stack_is_refused():
    with pytest.raises(InputError, match="no stack"):
        slices_from_stacks([])


@pytest.mark.parametrize(
    "change",
    [
        {"spacing_mm": [[0.0, 1]]},
        {"shape": [[0, 3]]},
        {"psf_var_mm2": [[-1.0, 0, 0]]},
        {"center_mm": [[np.nan, 0, 0]]},
        {"center_mm": [[0.0, 0]]},
    ],
)
def test_planes_without_meaning_are_refused(change):
    good = {
        "rotation": np.eye(3)[None],
        "center_mm": [[0.0, 0, 0]],
        "spacing_mm": [[1.0, 1]],
        "shape": [[4, 3]],
        "psf_var_mm2": [[0.1, 0.1, 1.0]],
    }
    Planes(**good)
    with pytest.raises(ValueError, match=r"planes need|expected|finite"):
        Planes(**(good | change))
