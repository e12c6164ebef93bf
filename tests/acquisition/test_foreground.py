"""Foreground of the result: slices vote where they lie; the shape decides about unseen voxels."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from g3r.acquisition.foreground import Foreground
from g3r.acquisition.mask_votes import foreground
from g3r.acquisition.slicing import slices_from_stacks
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid
from tests.acquisition.ellipsoids import (
    GRID,
    RADII_MM,
    TRUE_MM3,
    TURNS,
    WORLD,
    depth,
    ellipsoid_stack,
    foreground_mask,
    volume_of,
    without,
)


def beside_nothing(brain: NDArray[np.bool_], out_of_reach: NDArray[np.bool_]) -> Foreground:
    """Voxels that are wholly brain or not, and none that is hardly seen."""
    share, thin = brain.astype(np.float32), np.zeros_like(brain)
    return Foreground(brain=brain, core=brain, share=share, out_of_reach=out_of_reach, thin=thin)


@pytest.mark.parametrize("n_stacks", [1, 2, 3])
@pytest.mark.parametrize(("thickness_mm", "gap_mm"), [(2.2, 0.0), (4.0, 0.0), (3.0, 2.0)])
def test_the_volume_is_the_heads(n_stacks: int, thickness_mm: float, gap_mm: float) -> None:
    stacks = [ellipsoid_stack(t, thickness_mm=thickness_mm, gap_mm=gap_mm) for t in TURNS[:n_stacks]]
    found = foreground(slices_from_stacks(stacks), GRID)
    assert not found.out_of_reach[depth(WORLD) > -0.2].any()
    mask = found.support()
    # generous (INSIDE_SHARE below one half), with one stack as with three
    excess_mm = np.cbrt(RADII_MM.prod()) * (np.cbrt(volume_of(mask) / TRUE_MM3) - 1)
    assert 0 < excess_mm < 0.27 * (thickness_mm + gap_mm)
    if thickness_mm + gap_mm < 3:
        assert volume_of(mask) == pytest.approx(TRUE_MM3, rel=0.08)
        assert volume_of(found.mask()) == pytest.approx(TRUE_MM3, rel=0.02)
    assert not (found.mask() & ~mask).any()
    assert mask[depth(WORLD) > 0.05].all()  # gaps are closed
    assert not mask[depth(WORLD) < -0.2].any()
    assert label(mask)[1] == 1


def test_a_left_handed_header_ends_where_a_right_handed_one_does() -> None:
    right, left = (foreground_mask(slices_from_stacks([ellipsoid_stack(left_handed=flag)])) for flag in (False, True))
    assert volume_of(left) == pytest.approx(volume_of(right), rel=0.02)
    assert (left != right).sum() < 0.05 * right.sum()


def test_a_cut_off_end_is_unseen_and_not_background() -> None:
    """The slices end inside the head, and the shape given by the network decides about the part beyond them."""
    found = foreground(slices_from_stacks([ellipsoid_stack(low_mm=0.0, thickness_mm=4.0)]), GRID)
    z = WORLD[..., 2]
    # the mask ends three quarters of the slice spacing beyond the centre of the last slice
    assert found.out_of_reach[z < -3.8].all()
    assert not found.out_of_reach[(z > -2.2) & (np.abs(WORLD).max(-1) < 38)].any()
    assert found.brain[(z > 2) & (depth(WORLD) > 0.15)].all()
    assert not (found.brain & found.out_of_reach).any()
    # without a network the mask ends with the slices
    assert not found.support()[z < -3.8].any()
    # with a network it is the whole head
    likely = (depth(WORLD) > 0).astype(np.float32)
    mask = found.mask(likely)
    assert mask[depth(WORLD) > 0.1].all()
    assert volume_of(mask) == pytest.approx(TRUE_MM3, rel=0.12)


def test_without_a_network_the_hull_of_what_was_seen_fills_a_missing_slab() -> None:
    found = foreground(slices_from_stacks([without(ellipsoid_stack(), -6.5, 6.5)]), GRID)
    slab = np.abs(WORLD[..., 2]) < 4
    assert found.out_of_reach[slab].all()
    mask = found.support()
    assert mask[slab & (depth(WORLD) > 0.06)].all()
    assert not mask[depth(WORLD) < -0.2].any()
    assert label(mask)[1] == 1
    whole = foreground_mask(slices_from_stacks([ellipsoid_stack()]))
    assert volume_of(mask) == pytest.approx(volume_of(whole), rel=0.05)
    # without any filling one of the two ends would be lost
    nothing = found.support(np.zeros(GRID.shape))
    assert volume_of(nothing) < 0.55 * volume_of(mask)


def test_the_hull_reaches_the_borders_of_the_grid() -> None:
    brain = np.zeros((12, 5, 6), bool)
    brain[1:3], brain[8:11] = True, True
    out_of_reach = np.zeros_like(brain)
    out_of_reach[4:7], out_of_reach[11] = True, True
    seen = brain | (np.arange(12) == 3)[:, None, None] | (np.arange(12) == 7)[:, None, None]
    mask = beside_nothing(seen, out_of_reach).support()
    assert mask[1:11].all()
    assert not mask[[0, 11]].any()


def test_a_flat_or_lone_brain_has_no_hull() -> None:
    brain, out_of_reach = np.zeros((6, 6, 6), bool), np.ones((6, 6, 6), bool)
    brain[3, 1:5, 1:5], out_of_reach[3] = True, False
    found = beside_nothing(brain, out_of_reach)
    np.testing.assert_array_equal(found.support(), brain)


def test_a_probability_decides_unseen_voxels_and_never_seen_ones() -> None:
    found = foreground(slices_from_stacks([ellipsoid_stack(low_mm=0.0)]), GRID)
    right = (WORLD[..., 0] > 0) & (WORLD[..., 2] < 0)  # one piece with what was seen
    contrary = np.where(found.out_of_reach, right, ~found.brain).astype(np.float32)
    np.testing.assert_array_equal(found.mask(contrary), found.core | (found.out_of_reach & right))
    shown = found.support(contrary)
    np.testing.assert_array_equal(shown & ~found.thin, (found.brain | (found.out_of_reach & right)) & ~found.thin)
    # where coverage is low, the shown image may extend for two voxels
    margin = shown & ~(found.brain | (found.out_of_reach & right))
    assert margin.any()
    assert not (margin & ~binary_dilation(found.brain | (found.out_of_reach & right), iterations=2)).any()
    # improbable voxels are not shown, and undecided ones are not in the mask
    np.testing.assert_array_equal(found.support(np.full(GRID.shape, 0.25)), found.support(0 * contrary))
    np.testing.assert_array_equal(found.mask(np.full(GRID.shape, 0.5)), found.mask(0 * contrary))


def test_what_is_merely_possible_is_shown_beside_the_mask_alone() -> None:
    """Possible voxels form a slab at the border of the grid that touches the brain, as from an unsure network."""
    seen, possible = np.zeros((30, 9, 9), bool), np.zeros((30, 9, 9), bool)
    seen[2:9], possible[9:27] = True, True
    found = replace(beside_nothing(seen, ~seen), possible_voxels=4)
    np.testing.assert_array_equal(found.mask(0.4 * possible), seen)
    shown = found.support(0.4 * possible)
    assert shown[2:13].all()
    assert not shown[13:].any()
    # probable voxels are in the mask and shown in full
    assert found.support(0.6 * possible)[2:27].all()


def test_what_slices_hardly_saw_is_shown_where_the_network_expects_brain() -> None:
    brain, thin = np.zeros((12, 9, 9), bool), np.zeros((12, 9, 9), bool)
    brain[2:6], thin[6:10] = True, True
    found = replace(beside_nothing(brain, ~brain), thin=thin)
    probability = np.zeros(brain.shape)
    probability[6, :4] = 0.4
    support = found.support(probability)
    assert support[6:8].all()  # fitted there with a margin of two voxels
    edge = found.edge(support, found.mask(probability), probability)
    assert (edge[2:6] == 1).all()
    assert (edge[6, :4] == 1).all()
    assert not edge[6, 4:].any()
    assert not edge[7:].any()
    # without a network nothing tells where the brain ends
    assert (found.edge(support, found.mask(), None)[6:8] == 1).all()


def test_a_factor_common_to_all_weights_says_nothing() -> None:
    slices = slices_from_stacks([ellipsoid_stack(low_mm=0.0), ellipsoid_stack(TURNS[1], low_mm=-10.0)])
    one = foreground(slices, GRID)
    for factor in (0.5, 1e-3):
        other = foreground(slices, GRID, np.full(len(slices), factor))
        assert (one.brain != other.brain).mean() < 1e-4
        assert (one.out_of_reach != other.out_of_reach).mean() < 1e-4


def test_slices_without_weight_have_seen_nothing() -> None:
    slices = slices_from_stacks([ellipsoid_stack()])
    weight = np.where(np.abs(slices.planes.center_mm[:, 2]) < 6.5, 0.0, 1.0)
    assert (weight == 0).sum() >= 4
    blank = foreground(slices_from_stacks([without(ellipsoid_stack(), -6.5, 6.5)]), GRID)
    found = foreground(slices, GRID, weight)
    np.testing.assert_array_equal(found.out_of_reach, blank.out_of_reach)
    np.testing.assert_array_equal(found.brain, blank.brain)


def test_a_slice_without_weight_has_no_vote() -> None:
    """A misplaced slice would put brain beside the head and a hole into it."""
    slices = slices_from_stacks([ellipsoid_stack(t) for t in TURNS])
    good = foreground_mask(slices)
    away = np.abs(slices.planes.center_mm @ TURNS[0][:, 2]) < 8
    away &= slices.stack_id == 0
    assert 3 <= away.sum() <= 6
    center = slices.planes.center_mm.copy()
    center[away] += [0, 0, 24.0]
    astray = slices.with_pose(RigidPose(slices.planes.rotation, center))
    weight = np.where(away, 0.0, 1.0)
    trusting, careful = foreground_mask(astray), foreground_mask(astray, weight)
    assert (careful != good).sum() < 0.5 * (trusting != good).sum()
    # neither their poses nor their contents matter
    elsewhere = slices.with_pose(RigidPose(slices.planes.rotation, center + away[:, None] * 5.0))
    np.testing.assert_array_equal(foreground_mask(elsewhere, weight), careful)


def test_what_one_stack_alone_has_seen_stays_inside() -> None:
    """Two stacks that cover half of the head do not vote about the other half."""
    whole = ellipsoid_stack(TURNS[0])
    partly = [ellipsoid_stack(t, low_mm=0.0) for t in TURNS[1:]]
    found = foreground(slices_from_stacks([whole, *partly]), GRID)
    assert not found.out_of_reach[depth(WORLD) > -0.2].any()
    mask = found.support()
    uncovered = (WORLD @ TURNS[1][:, 2] < -8) & (WORLD @ TURNS[2][:, 2] < -8) & (depth(WORLD) > 0.1)
    assert uncovered.sum() > 500
    assert mask[uncovered].all()
    assert volume_of(mask) == pytest.approx(TRUE_MM3, rel=0.08)


def test_what_most_stacks_call_outside_is_outside() -> None:
    stacks = [ellipsoid_stack(t) for t in TURNS]
    spilt = stacks[0].mask | (np.arange(stacks[0].mask.shape[0]) < 22)[:, None, None]
    wrong = replace(stacks[0], mask=spilt)
    many = [wrong, *stacks[1:], *stacks[1:]]
    mask = foreground_mask(slices_from_stacks(many))
    # the other stacks cover all of it, however far it is from their masks
    assert mask[depth(WORLD) < -0.12].mean() < 0.02


def test_holes_are_filled_and_only_the_largest_piece_stays() -> None:
    whole, stack = slices_from_stacks([ellipsoid_stack()]), ellipsoid_stack(hole=True)
    crumb = stack.mask.copy()
    crumb[2:8, 2:8, 4:7] = True
    mask = foreground_mask(slices_from_stacks([replace(stack, mask=crumb)]))
    assert mask[np.linalg.norm(WORLD, axis=-1) < 5].all()
    assert label(mask)[1] == 1
    assert volume_of(mask) == pytest.approx(volume_of(foreground_mask(whole)), rel=0.01)


def test_the_mask_moves_with_the_slices() -> None:
    slices = slices_from_stacks([ellipsoid_stack(t) for t in TURNS])
    shift = np.array([3.0, -4.5, 1.5])  # whole voxels
    moved = slices.with_pose(RigidPose(slices.planes.rotation, slices.planes.center_mm + shift))
    here, there = foreground_mask(slices), foreground_mask(moved)
    np.testing.assert_array_equal(np.roll(here, (2, -3, 1), (0, 1, 2)), there)


@pytest.mark.parametrize("n_slices", [1, 2])
def test_one_or_two_slices_are_enough(n_slices: int) -> None:
    slices = slices_from_stacks([ellipsoid_stack()])
    middle = int(np.argmin(np.abs(slices.planes.center_mm[:, 2])))
    few = slices.take(np.arange(middle, middle + n_slices))
    mask = foreground_mask(few)
    thickness_mm = volume_of(mask) / (np.pi * RADII_MM[0] * RADII_MM[1])
    assert 0.8 * 3 * n_slices < thickness_mm < 3 * n_slices + 3  # beyond a lone slice the shape is not consulted


def test_the_foreground_of_nothing_is_refused() -> None:
    slices = slices_from_stacks([ellipsoid_stack()])
    far = VolumeGrid.isotropic([500] * 3, [520] * 3, 2.0)
    with pytest.raises(InputError, match="no voxel is covered"):
        foreground(slices, far)
    with pytest.raises(InputError, match="no voxel is covered"):
        foreground(slices, GRID, np.zeros(len(slices)))
