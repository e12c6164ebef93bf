"""The edge by the image: found if everything beside the brain is black, otherwise left to the masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.edge_by_image import FULL_MM, shown_by_image
from g3r.fitting.slice_stage import SliceFit
from g3r.geometry import VolumeGrid
from tests.fitting.scene import true_cloud
from tests.gaussians.scenes import slices_of, stack_planes

GRID = VolumeGrid.isotropic([-16] * 3, [16] * 3, 1.0)
RADIUS_MM = np.linalg.norm(GRID.world(np.moveaxis(np.indices(GRID.shape), 0, -1)), axis=-1)
BRAIN_MM, SUPPORT_MM = 7.5, 9.0
"""Radius of the brain, and of its generously drawn masks."""
SUPPORT = RADIUS_MM < SUPPORT_MM
TISSUE = 0.6 + 0.1 * np.sin(GRID.world(np.moveaxis(np.indices(GRID.shape), 0, -1))[..., 0] / 2)
NEAR = RADIUS_MM < SUPPORT_MM + 1


def slices_that_see(
    beside: float,
    gain: NDArray[np.float64] | None = None,
    noise: float = 0.01,
    mask_mm: float = SUPPORT_MM,
    tissue: NDArray[np.float64] = TISSUE,
) -> Slices:
    """Three stacks of a ball of tissue with a given intensity beside it."""
    planes = stack_planes(14, 2.0, 30)
    scene = np.where(RADIUS_MM < BRAIN_MM, tissue, beside).astype(np.float32)
    operator = VoxelOperator(planes, GRID, np.arange(planes.n_pixels), (3, 3, 5))
    value = operator.forward(scene)
    if gain is not None:
        value = value * gain[planes.plane_id()]
    rng = np.random.default_rng(0)
    value = np.hypot(value + rng.normal(0, noise, len(value)), rng.normal(0, noise, len(value)))
    mask = np.linalg.norm(planes.pixel_world_mm(), axis=1) < mask_mm
    return slices_of(planes, value.astype(np.float32), mask, 3, 2.0)


def shown(
    slices: Slices,
    gain: NDArray[np.float64] | None = None,
    bias_field: list[list[float]] | None = None,
    tissue: NDArray[np.float64] = TISSUE,
) -> NDArray[np.float32] | None:
    """Edge of a volume that extends beyond the brain, as a volume fitted to masked pixels does."""
    ones = np.ones(len(slices))
    fit = SliceFit(
        cloud=true_cloud(),
        slices=slices,
        gain=ones if gain is None else gain,
        weight=ones,
        history=[],
        bias_field=bias_field or [],
    )
    edge = np.where(NEAR, 1, 0).astype(np.float16)
    volume = (tissue * NEAR).astype(np.float32)
    return shown_by_image(volume, edge, SUPPORT, GRID, fit, slices)


def errors(found: NDArray[np.float32] | None) -> tuple[float, float]:
    """Mean deficit inside the brain and mean excess beside it, in the two voxels next to its edge."""
    assert found is not None
    inside = (RADIUS_MM < BRAIN_MM - 0.5) & (RADIUS_MM > BRAIN_MM - 2)
    beside = (RADIUS_MM > BRAIN_MM + 0.5) & NEAR
    return float(1 - found[inside].mean()), float(found[beside].mean())


def test_the_volume_ends_where_the_image_becomes_black() -> None:
    found = shown(slices_that_see(0.0))
    lacking, beside = errors(found)
    assert lacking < 0.02
    assert beside < 0.25  # without the edge all of it would be shown
    assert found is not None
    assert (found[SUPPORT & (RADIUS_MM < SUPPORT_MM - FULL_MM - 1)] == 1).all()


def test_gains_and_noise_do_not_move_the_edge() -> None:
    gain = np.linspace(0.6, 1.6, 42)
    even = errors(shown(slices_that_see(0.0)))
    uneven = errors(shown(slices_that_see(0.0, gain), gain))
    noisy = errors(shown(slices_that_see(0.0, noise=0.06)))
    very_noisy = errors(shown(slices_that_see(0.0, noise=0.12)))
    np.testing.assert_allclose(uneven, even, atol=0.03)
    np.testing.assert_allclose(noisy, even, atol=0.1)
    np.testing.assert_allclose(very_noisy, even, atol=0.3)  # the mean of such noise in black: a quarter of tissue


def test_the_edge_of_dark_tissue_is_found_as_well() -> None:
    x = GRID.world(np.moveaxis(np.indices(GRID.shape), 0, -1))[..., 0]
    tissue = np.where(x < 0, 0.2, 0.9)
    found = shown(slices_that_see(0.0, tissue=tissue), tissue=tissue)
    assert found is not None
    beside = (RADIUS_MM > BRAIN_MM + 0.5) & NEAR
    assert found[beside & (x > 1)].mean() < 0.02
    assert found[beside & (x < -1)].mean() < 0.02


def test_the_field_of_the_fit_is_that_of_its_masks() -> None:
    """Terms of a field have zero mean over masked pixels, so over all pixels of the boxes they would differ."""
    slices = slices_that_see(0.0)
    field = [[0.0, 0.0, 20.0, 0.0, 20.0]] * 3
    under = np.exp(StackBiasField(slices).log_field(np.array(field)))
    plain, shaded = errors(shown(slices)), errors(shown(replace(slices, value=slices.value * under), bias_field=field))
    np.testing.assert_allclose(shaded, plain, atol=0.02)


@pytest.mark.parametrize("beside", [0.2, 0.3, 1.0])
def test_masks_decide_where_something_lies_beside_the_brain(beside: float) -> None:
    assert shown(slices_that_see(beside)) is None


def test_masks_decide_where_no_pixel_beside_the_brain_is_kept() -> None:
    planes = stack_planes(4, 2.0, 8)
    value, mask = np.full(planes.n_pixels, 0.6, np.float32), np.ones(planes.n_pixels, bool)
    assert np.linalg.norm(planes.pixel_world_mm(), axis=1).max() < SUPPORT_MM
    assert shown(slices_of(planes, value, mask, 3, 2.0)) is None


def test_zeros_beyond_the_masks_show_no_edge() -> None:
    """Of images that were cut at their masks: there, pixels on the edge hold brain, too."""
    slices = slices_that_see(0.0, mask_mm=BRAIN_MM)
    cut = replace(slices, value=np.where(slices.mask, slices.value, 0).astype(np.float32))
    assert shown(slices) is not None
    assert shown(cut) is None
    # one stack that was not cut shows it
    whole = cut.planes.plane_id() < np.count_nonzero(cut.stack_id == 0)
    found = shown(replace(cut, value=np.where(whole, slices.value, cut.value)))
    assert found is not None
    assert found[(RADIUS_MM < BRAIN_MM) & SUPPORT].mean() > 0.9


def test_nothing_is_asked_of_black_images() -> None:
    slices = slices_that_see(0.0)
    assert shown(replace(slices, value=np.zeros_like(slices.value))) is None


def test_voxels_that_are_too_fine_for_the_pixels_are_left_to_the_masks() -> None:
    slices = slices_that_see(0.0)
    coarse = replace(slices, planes=replace(slices.planes, spacing_mm=2.5 * slices.planes.spacing_mm))
    assert shown(coarse) is None


def test_what_a_mask_leaves_out_is_not_taken_away() -> None:
    """If the brain reaches beyond a support that is too small, it does not fade."""
    slices = slices_that_see(0.0, mask_mm=6.0)
    ones = np.ones(len(slices))
    fit = SliceFit(cloud=true_cloud(), slices=slices, gain=ones, weight=ones, history=[], bias_field=[])
    support = RADIUS_MM < 6.0
    found = shown_by_image((TISSUE * support).astype("f4"), support.astype("f2"), support, GRID, fit, slices)
    assert found is not None
    assert found[support].mean() > 0.98
