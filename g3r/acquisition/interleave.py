"""The order in which the slices of a stack are acquired."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pass_and_place(
    number: NDArray[np.int64], interleave: int | NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The pass of the acquisition that takes each slice, and the place of the slice in that pass.

    Args:
        number: [K] numbers of slices in their stacks, from 0.
        interleave: of the stack, or [K] of the stack of each slice.
    """
    return number % interleave, number // interleave


def acquisition_order(n_slices: int, interleave: int) -> NDArray[np.int64]:
    """Slice numbers in the order of acquisition: interleave 1 is sequential, 2 takes every second one first, and so on.

    Raises:
        ValueError: an interleave below 1.
    """
    if interleave < 1:
        raise ValueError(f"interleave {interleave}; expected at least 1")
    its_pass, place = pass_and_place(np.arange(n_slices), interleave)
    return np.lexsort((place, its_pass))


def place_in_time(n_slices: int, interleave: int) -> NDArray[np.int64]:
    """Acquisition rank of each slice of a stack [K], in the order of the slices in space."""
    place = np.empty(n_slices, np.int64)
    place[acquisition_order(n_slices, interleave)] = np.arange(n_slices)
    return place
