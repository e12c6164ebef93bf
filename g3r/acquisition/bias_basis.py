"""The second-order bias field of a stack: polynomial terms in the in-plane coordinates of its header.

The receive coil is fixed while the fetus moves, so the field belongs to the header frame of a stack.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices

LENGTH_MM = 40.0
"""Unit of the coordinates, about half a head: coefficients are log-intensities at that distance."""

N_TERMS = 5


def quadratic_terms(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """x, y, x^2, xy, y^2 [P, 5] at coordinates [P] in units of `LENGTH_MM`; the constant term is the slice's gain."""
    return np.stack([x, y, x * x, x * y, y * y], axis=1)


def stacks_by_header(
    slices: Slices,
) -> Iterator[tuple[slice, NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]]:
    """The pixels of each stack at their header positions.

    Yields:
        For each stack the range of its pixels, their mask [P], their world positions [P, 3] (mm) and the
        in-plane axes [3, 2].
    """
    planes = slices.planes.with_pose(slices.header_pose)
    world_mm = planes.pixel_world_mm()
    for stack in np.unique(slices.stack_id):
        rows = np.flatnonzero(slices.stack_id == stack)
        pixels = slice(int(planes.offset[rows[0]]), int(planes.offset[rows[-1] + 1]))  # slices of a stack are adjacent
        yield pixels, slices.mask[pixels], world_mm[pixels], slices.header_pose.rotation[rows[0]][:, :2]
