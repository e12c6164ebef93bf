"""Intruders: how much better the slices of all other stacks fit a volume without one stack.

A stack of another head of the same age finds a place among the others, and the volume becomes a mean of both heads.
All stacks then agree with it about equally, and less than they would with their own head, so no comparison of one stack
with the others tells which one is to blame. It is found by what the others gain without it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.registration.slice_rounds import FittedSlices, correlation_with_all
from g3r.registration.thresholds import IN_PLACE_NCC


def misfit_without_each(fitted: FittedSlices, voxel_mm: float, max_pixels: int) -> list[float | None] | None:
    """Share of the misfit of all others that is left without a stack, for the stack without which least is left.

    The misfit of a slice is 1 minus its correlation with the volume. It always falls in a volume of fewer stacks, since
    each slice then is a larger part of the volume.

    Args:
        fitted: slices of three or more stacks, in place.
        voxel_mm: of the volumes.
        max_pixels: number of pixels in use, at most.

    Returns:
        The median over the slices of the other stacks, at the place of that stack, and None for the others: without a
        sound stack the rest gain, too, as long as an intruder stays. None for fewer than three stacks, where those left
        have nothing to agree with, and where the slices of any stack fit as those of stacks in place do: they would not
        fit a mean of two heads.
    """
    slices: Slices = fitted.slices
    stacks = np.unique(slices.stack_id).tolist()
    fit = [float(np.median(fitted.ncc[slices.stack_id == stack])) for stack in stacks]
    if len(stacks) < 3 or max(fit) >= IN_PLACE_NCC:
        return None
    found = []
    for stack in stacks:
        others: NDArray[np.int64] = np.flatnonzero(slices.stack_id != stack)
        gain, weight = fitted.gain[others], fitted.weight[others]
        ncc = correlation_with_all(slices.take(others), gain, weight, voxel_mm, max_pixels)
        found.append(float(np.median((1 - ncc) / np.maximum(1 - fitted.ncc[others], 1e-6))))
    least = int(np.argmin(found))
    return [one if n == least else None for n, one in enumerate(found)]
