"""Simulated gaps in coverage: runs of missing slices, and fields of view that cut the head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data_synth.simulator import SimulatedStack
from g3r.acquisition.stacks import Stack

EVEN_SHARE = 0.3
"""Share of subjects with complete stacks."""
CUT_SHARE = 0.5
"""Share of incomplete subjects whose stacks are cut by their fields of view; the others have missing slices."""
BOTH_SHARE = 0.2
"""Share of incomplete subjects with both defects."""
CONCERNED_SHARE = 0.75
"""Share of a subject's stacks that are incomplete; a cut on the same side (`SAME_SIDE_SHARE`) affects all stacks."""
MISSING_SLICES = (1, 8)
"""Range of the length of a run of missing slices."""
MIN_SLICES = 4
"""Least number of masked slices that a stack keeps, and of masked rows or columns."""
CUT = (0.2, 0.6)
"""Share of the head's extent that a field of view leaves out."""
SAME_SIDE_SHARE = 0.6
"""Share of cut subjects whose stacks all miss the same side of the head, as from a plan that was too small."""


def with_uneven_coverage(stacks: Sequence[SimulatedStack], rng: np.random.Generator) -> list[SimulatedStack]:
    """Stacks some of which lack slices or are cut by their fields of view.

    Missing slices remain in the stack as zeros, like blanked slices in files, so that slice numbers and poses stay
    valid. A cut through the stack blanks all slices beyond it; an in-plane cut makes the images smaller.

    Args:
        stacks: as simulated, with masks.
        rng: source of randomness.
    """
    kind = rng.random()
    if kind < EVEN_SHARE:
        return list(stacks)
    cuts = rng.random() < CUT_SHARE
    both = rng.random() < BOTH_SHARE
    result = list(stacks)
    if cuts or both:
        result = _with_cuts(result, rng)
    if not cuts or both:
        result = [_with_missing_run(one, rng) if rng.random() < CONCERNED_SHARE else one for one in result]
    return result


def emptied(stack: Stack, first: int, last: int) -> Stack:
    """A stack with slices `first` to `last` - 1 blanked (zero, with empty masks); unchanged if no mask would be left.

    Args:
        stack: to change.
        first: number of a slice.
        last: number of the slice after the run.
    """
    image, mask = stack.image.copy(), stack.mask.copy()
    image[:, :, first:last], mask[:, :, first:last] = 0, False
    return replace(stack, image=image, mask=mask) if mask.any() else stack


def without_slices(one: SimulatedStack, first: int, last: int) -> SimulatedStack:
    """A simulated stack with slices `first` to `last` - 1 blanked; see `emptied`.

    Args:
        one: to change.
        first: number of a slice.
        last: number of the slice after the run.
    """
    stack = emptied(one.stack, first, last)
    return one if stack is one.stack else replace(one, stack=stack)


def _with_missing_run(one: SimulatedStack, rng: np.random.Generator) -> SimulatedStack:
    masked = np.flatnonzero(one.stack.mask.any((0, 1)))
    longest = min(MISSING_SLICES[1], len(masked) - MIN_SLICES)
    if longest < MISSING_SLICES[0]:
        return one
    n = int(rng.integers(MISSING_SLICES[0], longest + 1))
    first = int(masked[rng.integers(len(masked) - n + 1)])
    return without_slices(one, first, first + n)


def _with_cuts(stacks: Sequence[SimulatedStack], rng: np.random.Generator) -> list[SimulatedStack]:
    direction = rng.standard_normal(3)
    share = rng.uniform(*CUT)
    same = rng.random() < SAME_SIDE_SHARE
    result = []
    for one in stacks:
        concerned = same or rng.random() < CONCERNED_SHARE
        if concerned:
            if not same:
                direction, share = rng.standard_normal(3), rng.uniform(*CUT)
            one = _cut(one, direction, share)
        result.append(one)
    return result


def _cut(one: SimulatedStack, direction: NDArray[np.float64], share: float) -> SimulatedStack:
    """A stack without the end of the head in a direction, cut perpendicular to the stack axis closest to it."""
    stack = one.stack
    along = stack.grid.axes.T @ direction
    axis = int(np.argmax(np.abs(along)))
    marked = np.flatnonzero(stack.mask.any(tuple(other for other in range(3) if other != axis)))
    n = min(round(share * len(marked)), len(marked) - MIN_SLICES)
    if n < 1:
        return one
    at_end = along[axis] > 0
    if axis == 2:
        edge = int(marked[len(marked) - n] if at_end else marked[n])
        return without_slices(one, edge, stack.image.shape[2]) if at_end else without_slices(one, 0, edge)
    kept = slice(0, int(marked[len(marked) - n])) if at_end else slice(int(marked[n]), stack.image.shape[axis])
    cropped = _cropped(stack, axis, kept)
    return one if cropped is None else replace(one, stack=cropped)


def _cropped(stack: Stack, axis: int, kept: slice) -> Stack | None:
    """The stack with fewer rows or columns; None if no masked pixel would be left."""
    box = tuple(kept if other == axis else slice(None) for other in range(3))
    mask = stack.mask[box]
    if not mask.any():
        return None
    affine = stack.affine.copy()
    affine[:3, 3] = stack.affine[:3, :3] @ (np.eye(3)[axis] * kept.start) + stack.affine[:3, 3]
    return replace(stack, image=np.ascontiguousarray(stack.image[box]), mask=mask, affine=affine)
