"""Votes of masks: those of parallel stacks count less each."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.foreground import Foreground
from g3r.acquisition.mask_votes import foreground
from g3r.acquisition.orientations import votes_per_stack
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from tests.acquisition.ellipsoids import GRID, TURNS, WORLD, depth, ellipsoid_stack, volume_of

CAP_FROM_MM = 14.0


def without_cap(stack: Stack) -> Stack:
    """The stack with a mask that misses the slices of the crown, which the image shows."""
    height = stack.affine[2, 3] + stack.affine[2, 2] * np.arange(stack.image.shape[2])
    return replace(stack, mask=stack.mask & (height < CAP_FROM_MM))


def found_with(n_parallel: int, n_others: int) -> Foreground:
    cut = [without_cap(ellipsoid_stack(thickness_mm=3.0 + 0.1 * n)) for n in range(n_parallel)]
    return foreground(slices_from_stacks([*cut, *(ellipsoid_stack(turn) for turn in TURNS[1 : 1 + n_others])]), GRID)


def cap() -> NDArray[np.bool_]:
    return (WORLD[..., 2] > CAP_FROM_MM + 2) & (depth(WORLD) > 0.05)


@pytest.mark.parametrize("n_others", [1, 2])
def test_parallel_stacks_do_not_outvote_the_others_where_their_masks_end(n_others: int) -> None:
    """What five parallel masks miss is shown in full; if two other stacks call it brain, it is in the mask, too."""
    one, five = found_with(1, n_others), found_with(5, n_others)
    support = five.support()
    assert one.support()[cap()].all()
    assert support[cap()].mean() > 0.8
    assert five.edge(support, five.mask())[cap()].mean() > 0.99
    if n_others == 2:
        assert volume_of(five.mask()) == pytest.approx(volume_of(one.mask()), rel=0.03)


def test_what_several_stacks_saw_is_seen_by_one_of_them() -> None:
    """Parallel stacks count less in what is brain, not in what was seen: what one of five stacks saw is seen."""
    stacks = [ellipsoid_stack(thickness_mm=3.0 + 0.1 * n, low_mm=0.0) for n in range(4)]
    found = foreground(slices_from_stacks([*stacks, ellipsoid_stack()]), GRID)
    assert not found.out_of_reach[depth(WORLD) > -0.1].any()
    assert found.core[depth(WORLD) > 0.05].all()


def test_parallel_stacks_count_as_at_most_two() -> None:
    tilted = Rotation.from_euler("x", 20, degrees=True).as_matrix()
    across = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    stacks = [ellipsoid_stack(turn) for turn in (TURNS[0], tilted, across, -TURNS[0] @ np.diag([1, -1, 1]), TURNS[1])]
    slices = slices_from_stacks(stacks)
    votes = votes_per_stack(slices)
    by_stack = [set(votes[slices.stack_id == n]) for n in range(5)]
    # the second is 20 degrees from the third, too; the sign of a normal says nothing
    assert by_stack == [{1 / 2}, {1 / 2.5}, {1 / 1.5}, {1 / 2}, {1.0}]
    many = slices_from_stacks([ellipsoid_stack()] * 9)
    assert votes_per_stack(many)[many.stack_id == 0][0] * 9 == pytest.approx(1.8)
