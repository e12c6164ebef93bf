"""Stacks that were set to zero around the brain or around their field of view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.cut_images import cut_at_mask, field_of_view, mask_of_content, without_residue
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack
from tests.acquisition.nifti_files import write
from tests.gaussians.scenes import slices_of, stack_planes


def test_zeros_beside_the_mask_tell_stacks_that_were_cut() -> None:
    planes = stack_planes(4, 2.0, 12)
    radius_mm = np.linalg.norm(planes.pixel_world_mm(), axis=1)
    # a head in black without noise: pixels beside the mask are partly brain, those further out zero
    value = np.clip((6.0 - radius_mm) / 2.0, 0, 1).astype(np.float32)
    slices = slices_of(planes, value, radius_mm < 4.5, 3, 2.0)
    assert not cut_at_mask(slices).any()
    second = (slices.stack_id == 1)[planes.plane_id()]
    cut = replace(slices, value=np.where(second & ~slices.mask, 0, value).astype(np.float32))
    assert (cut_at_mask(cut) == (slices.stack_id == 1)).all()
    assert not cut_at_mask(replace(slices, mask=np.ones_like(slices.mask))).any()


SHAPE = (20, 20, 6)
RADIUS = np.linalg.norm((np.indices(SHAPE[:2]).T - 9.5).T, axis=0)[:, :, None] * np.ones(SHAPE[2])


def stack_of(image: np.ndarray, mask: np.ndarray) -> Stack:
    return Stack(image=image, mask=mask, affine=np.diag([1.0, 1.0, 3.0, 1.0]), thickness_mm=3.0)


def brain(within: float, **rest: float) -> np.ndarray:
    """Noise that is nowhere zero, and zeros beyond a radius."""
    image = np.random.default_rng(0).uniform(50, 100, SHAPE)
    return np.where(within > RADIUS, image, rest.get("beyond", 0.0)).astype(np.float32)


def test_zeros_around_an_extracted_brain_leave_a_wide_mask(tmp_path: Path) -> None:
    image, wide = brain(5.0), RADIUS < 9
    image[9:11, 9:11, 2] = 0  # a dark spot in the brain
    image[:, :, 4] = 0  # a blank slice
    found = mask_of_content(image, wide)
    expected = RADIUS < 5
    expected[:, :, 4] = wide[:, :, 4]
    np.testing.assert_array_equal(found, expected)
    # noise around it: the mask holds
    np.testing.assert_array_equal(mask_of_content(brain(5.0, beyond=3.0), wide), wide)
    # of files; an array's mask is as it is given
    affine = np.diag([1.0, 1.0, 3.0, 1.0])
    paths = write(tmp_path / "a.nii.gz", image, affine), write(tmp_path / "m.nii.gz", wide.astype(np.uint8), affine)
    np.testing.assert_array_equal(load_stack(*paths, 3.0).mask, expected)


@pytest.mark.parametrize("padding", [0.0, 1e-3, -6e-3])
def test_a_padded_field_of_view_ends_where_zeros_begin(padding: float) -> None:
    image = brain(100.0)
    assert field_of_view(image) == ((0, 19), (0, 19))
    image[:4] = image[:, 18:] = padding
    assert field_of_view(without_residue(image)) == ((4, 19), (0, 17))
    extent = slices_from_stacks([stack_of(image, RADIUS < 5)]).fields_of_view.extent_mm
    np.testing.assert_allclose(extent, np.broadcast_to([[-6.0, 10.0], [-10.0, 8.0]], extent.shape))
    # an extracted brain is no rectangle, and nothing says where its field of view ended
    assert field_of_view(brain(7.0)) == ((0, 19), (0, 19))


@pytest.mark.parametrize("beyond", [1e-3, -6e-3, 0.5, -0.5])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_what_is_nearly_zero_beyond_an_extracted_brain_counts_as_zero(beyond: float, scale: float) -> None:
    """Half a grey level is more than a thousandth of the brain, but a constant."""
    image, wide = brain(5.0, beyond=beyond) * np.float32(scale), RADIUS < 9
    image[:, :, 4] = beyond * scale  # a blank slice
    image[3, 3, 1] = 3 * scale  # resampling leaves other values, too
    stack = stack_of(image, wide)
    np.testing.assert_array_equal(stack.image, np.where(image > scale, image, 0))
    kept = mask_of_content(without_residue(image), wide)
    assert kept.sum() < 1.01 * (RADIUS < 5)[:, :, :5].sum() + wide[:, :, 4].sum()
    assert 4 not in slices_from_stacks([stack]).slice_index  # blank: the mask alone would not tell


def test_files_of_whole_numbers_with_an_offset_hold_an_extracted_brain(tmp_path: Path) -> None:
    """One negative voxel makes nibabel choose a slope and an offset by which zero is no whole number."""
    affine, wide = np.diag([1.0, 1.0, 3.0, 1.0]), RADIUS < 9
    image = 10 * brain(5.0)
    image[9, 9, 2] = -3.7
    paths = tmp_path / "a.nii.gz", write(tmp_path / "m.nii.gz", wide.astype(np.uint8), affine)
    for dtype in (np.int16, np.uint8):
        stored = nib.Nifti1Image(image, affine)
        stored.set_data_dtype(dtype)
        nib.save(stored, paths[0])
        assert (nib.Nifti1Image.from_filename(paths[0]).get_fdata()[0] != 0).all()
        np.testing.assert_array_equal(load_stack(*paths, 3.0).mask, RADIUS < 5)


def test_noise_is_no_residue() -> None:
    """Neither where it is low, nor where it has few grey levels, nor with the zeros that whole numbers have."""
    rng = np.random.default_rng(0)
    for scale, noise in ((1.0, 3.0), (1.0, 1.0), (0.1, 1.0)):
        sizes = np.linalg.norm(rng.normal(0, noise, (2, *SHAPE)), axis=0) + scale * brain(5.0, beyond=0.0)
        for image in (sizes.astype(np.float32), np.rint(sizes).astype(np.float32)):
            changed = without_residue(image) != image
            assert changed.mean() < 0.001
    spots = 10 * brain(100.0)
    spots[:3, 0, 0] = 3.0  # a few dark pixels of one value are no background
    np.testing.assert_array_equal(without_residue(spots), spots)
    empty = np.zeros(SHAPE, np.float32)
    np.testing.assert_array_equal(without_residue(empty), empty)
    np.testing.assert_array_equal(without_residue(np.full(SHAPE, np.nan, np.float32)), np.full(SHAPE, np.nan))
