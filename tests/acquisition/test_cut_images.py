"""Stacks that were set to zero around the brain or around their field of view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from g3r.acquisition.cut_images import cut_at_mask, field_of_view, mask_of_content
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


def test_a_padded_field_of_view_ends_where_zeros_begin() -> None:
    image = brain(100.0)
    assert field_of_view(image) == ((0, 19), (0, 19))
    image[:4] = image[:, 18:] = 0
    assert field_of_view(image) == ((4, 19), (0, 17))
    extent = slices_from_stacks([stack_of(image, RADIUS < 5)]).fields_of_view.extent_mm
    np.testing.assert_allclose(extent, np.broadcast_to([[-6.0, 10.0], [-10.0, 8.0]], extent.shape))
    # an extracted brain is no rectangle, and nothing says where its field of view ended
    assert field_of_view(brain(7.0)) == ((0, 19), (0, 19))
