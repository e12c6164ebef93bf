"""Conversion of stacks to slices: cropping, normalisation, and geometry by the headers."""

from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from data_synth.phantom import fetal_brain_phantom
from g3r.acquisition.area_profile import head_volume_mm3
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.slicing import by_headers, normalised_slices, skipped_slice_notes, slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack
from g3r.errors import InputError
from tests.acquisition.nifti_files import AXES, affine_of, arrays, stacks_of_two, write
from tests.registration.moving_heads import as_slices, simulated


def test_the_masked_volume_is_the_heads() -> None:
    head = fetal_brain_phantom(24, 1.2)
    slices, _ = as_slices(simulated(head))
    true_mm3 = head.mask.sum() * abs(np.linalg.det(head.affine))
    assert head_volume_mm3(slices) == pytest.approx(true_mm3, rel=0.05)
    # for any choice of slices
    assert head_volume_mm3(slices.take(slices.stack_id == 1)) == pytest.approx(true_mm3, rel=0.07)
    other = slices.take(slices.slice_index % 2 == 0)
    assert head_volume_mm3(other) == pytest.approx(true_mm3, rel=0.07)
    one = slices.take([20])
    area = one.mask.sum() * one.planes.spacing_mm[0].prod()
    assert head_volume_mm3(one) == pytest.approx(area * one.thickness_mm[0])


def test_normalised_slices_have_their_99th_percentile_at_one() -> None:
    slices, scale = normalised_slices(stacks_of_two())
    assert np.percentile(slices.masked_value, 99) == pytest.approx(1)
    np.testing.assert_allclose(slices.value * scale, slices_from_stacks(stacks_of_two()).value, rtol=1e-6)


def assert_pixels_are_voxels(stack: Stack, image: np.ndarray, affine: np.ndarray, n_masked: int) -> None:
    """Every masked pixel of the slices: position and value are those of the voxel it was cut from."""
    slices = by_headers(slices_from_stacks([stack]), [stack])
    np.testing.assert_allclose(slices.world_from_header().translation_mm, 0, atol=0.02)  # header tolerance
    slices = slices.with_pose(slices.header_pose)
    world = slices.planes.pixel_world_mm(slices.pixel_index)
    assert len(world) == n_masked
    index = (np.linalg.inv(affine) @ np.c_[world, np.ones(len(world))].T)[:3].T
    nearest = np.rint(index).astype(int)
    by_affine = (affine @ np.c_[nearest, np.ones(len(world))].T)[:3].T
    np.testing.assert_allclose(world, by_affine, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(slices.masked_value, image[tuple(nearest.T)])


@pytest.mark.parametrize("name", AXES)
def test_pixels_lie_where_the_header_says(tmp_path: Path, name: str) -> None:
    image, mask = arrays()
    affine = affine_of(AXES[name])
    stack = load_stack(
        write(tmp_path / "a.nii.gz", image, affine), write(tmp_path / "m.nii.gz", mask.astype(np.uint8), affine), 2.5
    )
    kept = mask.sum((0, 1)) >= 12
    slices = slices_from_stacks([stack])
    stored = nib.Nifti1Image.from_filename(tmp_path / "a.nii.gz").affine  # float32 in the file
    assert_pixels_are_voxels(stack, image, stored, mask[:, :, kept].sum())
    assert slices.slice_index.tolist() == np.flatnonzero(kept).tolist()
    np.testing.assert_allclose(np.linalg.det(slices.planes.rotation), 1, atol=1e-12)
    np.testing.assert_allclose(slices.world_from_header().translation_mm, 0, atol=1e-12)
    np.testing.assert_allclose(slices.planes.psf_var_mm2[0], psf_variance_mm2([0.8, 0.9], 2.5), rtol=1e-6)


@pytest.mark.parametrize("through", [0, 1, 2])
def test_slices_on_any_axis_are_found_by_their_distance(tmp_path: Path, through: int) -> None:
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
    stored = nib.Nifti1Image.from_filename(path).affine
    assert_pixels_are_voxels(stack, image.transpose(order), stored, mask[:, :, kept].sum())
    assert slices.slice_index.tolist() == np.flatnonzero(kept).tolist()


def test_values_outside_the_mask_may_be_nan(tmp_path: Path) -> None:
    image, mask = arrays()
    image[~mask] = np.nan
    stack = Stack(image=image, mask=mask, affine=affine_of(AXES["RAS"]), thickness_mm=3.0)
    assert np.isfinite(stack.image).all()
    assert np.isfinite(slices_from_stacks([stack]).value).all()


def test_slices_with_hardly_a_pixel_are_left_out() -> None:
    image, mask = arrays()
    mask[:, :, 2] = False
    mask[5:8, 5:8, 2] = True
    slices = slices_from_stacks([Stack(image=image, mask=mask, affine=affine_of(AXES["RAS"]), thickness_mm=3.0)])
    assert 2 not in slices.slice_index
    mask[:] = False
    mask[5:8, 5:8] = True
    lonely = Stack(image=image, mask=mask, affine=affine_of(AXES["RAS"]), thickness_mm=3.0, name="lonely")
    with pytest.raises(InputError, match=r"lonely.*12 masked pixels"):
        slices_from_stacks([lonely])


def test_no_stack_is_refused() -> None:
    with pytest.raises(InputError, match="no stack"):
        slices_from_stacks([])


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_blank_slices_count_as_not_taken(value: float) -> None:
    before = stacks_of_two()
    image = before[0].image.copy()
    middle = image.shape[2] // 2
    image[:, :, middle] = value
    stacks = [replace(before[0], image=image), *before[1:]]
    slices = slices_from_stacks(stacks)
    of_first = slices.slice_index[slices.stack_id == 0].tolist()
    assert middle not in of_first
    assert len(slices) == len(slices_from_stacks(before)) - 1
    (note,) = skipped_slice_notes(stacks, slices)
    assert note == f"{stacks[0].name}: slices {middle} skipped, blank inside the mask: they count as not taken"
