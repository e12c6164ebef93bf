"""The rim of the brain: the share of the surroundings is removed from its pixels, whatever they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.acquisition.surroundings import LEAST_SHARE, without_surroundings
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid

GRID = VolumeGrid.isotropic(np.full(3, -30.0), np.full(3, 30.0), 1.0)
RADIUS_MM = 20.0
RADIUS = np.linalg.norm(GRID.world(np.moveaxis(np.indices(GRID.shape), 0, -1)), axis=-1)
BRAIN = RADIUS < RADIUS_MM


def stacks_of(volume: np.ndarray) -> Slices:
    """Three orthogonal stacks of a volume through the slice profile; masks end where the brain ends."""
    stacks = []
    for turn in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        shape, spacing = (56, 56, 18), np.array([1.0, 1.0, 3.0])
        affine = np.eye(4)
        affine[:3, :3] = np.eye(3)[:, turn] * spacing
        affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
        world = np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
        mask = np.linalg.norm(world, axis=-1) < RADIUS_MM
        stacks.append(Stack(image=world[..., 0].astype(np.float32) + 100, mask=mask, affine=affine, thickness_mm=3.0))
    slices = slices_from_stacks(stacks)
    value = VoxelOperator(slices.planes, GRID, None, (5, 5, 7)).forward(volume.astype(np.float32))
    return replace(slices, value=value.astype(np.float32))


def corrected(slices: Slices, gain: np.ndarray | None = None) -> tuple[Slices, np.ndarray]:
    ones = np.ones(len(slices))
    return without_surroundings(slices, BRAIN, GRID, ones if gain is None else gain, ones)


@pytest.mark.parametrize("outside", [0.0, 0.3, 1.0, 2.5])
def test_an_even_brain_is_even_up_to_its_rim_whatever_lies_beside_it(outside: float) -> None:
    slices = stacks_of(np.where(BRAIN, 1.0, outside))
    found, share = corrected(slices)
    # pixels that are mostly brain; in the others, differences are amplified
    good = slices.mask & (share > 0.6)
    before, after = (np.abs(one.value[good] - 1) for one in (slices, found))
    # where a mask touches its box, no pixel shows the surroundings, and nothing changes
    assert after.mean() < 0.35 * before.mean() + 1e-3
    assert np.quantile(after, 0.95) < 0.4 * np.quantile(before, 0.95) + 1e-3
    assert after.max() < before.max() + 1e-3
    deep = slices.mask & (share == 1)
    np.testing.assert_allclose(found.value[deep], slices.value[deep])
    assert deep.sum() > 0.5 * slices.mask.sum()


def test_the_share_is_that_of_the_profile_and_bounded() -> None:
    slices = stacks_of(BRAIN.astype(float))
    _, share = corrected(slices)
    # next to black, and with a brain intensity of one, a pixel's value is its share of brain
    exact = slices.value.clip(LEAST_SHARE, 1)
    assert np.abs(share - exact)[slices.mask].mean() < 0.01
    assert share.min() >= LEAST_SHARE


def test_gains_of_slices_do_not_matter() -> None:
    slices = stacks_of(np.where(BRAIN, 1.0, 0.4))
    gain = np.exp(np.random.default_rng(0).normal(0, 0.2, len(slices)))
    scaled = replace(slices, value=(slices.value * gain[slices.planes.plane_id()]).astype(np.float32))
    plain, share = corrected(slices)
    found, same = corrected(scaled, gain)
    np.testing.assert_allclose(same, share)
    index = slices.pixel_index
    np.testing.assert_allclose(found.value[index] / gain[slices.pixel_plane], plain.value[index], atol=2e-3)


def test_without_pixels_outside_nothing_is_known_and_nothing_changes() -> None:
    slices = stacks_of(BRAIN.astype(float))
    full = replace(slices, mask=np.ones(len(slices.value), bool))
    found, share = corrected(full)
    np.testing.assert_array_equal(found.value, full.value)
    assert (share == 1).all()
