"""Gains of the slices of a single stack, from neighbouring slices at the same place in plane.

No slice of another stack crosses these. But most of what a slice shows continues in the next one, so their
log-intensities differ by a constant, the difference of their gains. Only changes over a few slices can be found like
this: over many, gains and slow changes of the anatomy look alike, and gains are held at 1.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve

from g3r.acquisition.bias_basis import stacks_by_header
from g3r.acquisition.planes import Slices

Float64Array = NDArray[np.float64]

MIN_PIXELS = 50
"""Fewest pixels that two neighbours must share to be compared."""

SCALE = 0.1
"""Log-intensity by which a pixel may deviate from the usual difference: beyond, neighbours show other tissue there."""

DEVIATION, MIN_GAIN_DEVIATION = 0.02, 0.05
"""Expected deviation of the part of a step that is anatomy, and lower bound of the deviation of log-gains."""

MIN_INTENSITY = 0.1
"""Lower bound of a pixel before the logarithm is taken, as a share of the mean intensity."""

MAX_ROUNDS = 20


def neighbour_gains(slices: Slices) -> Float64Array:
    """Intensity factors [K] of slices of one stack, with a geometric mean of 1.

    Args:
        slices: K slices of one stack, as their header places them; poses do not matter.

    Raises:
        ValueError: slices of several stacks.
    """
    if slices.n_stacks != 1:
        raise ValueError(f"slices are of {slices.n_stacks} stacks; expected one")
    order = np.argsort(slices.slice_index, kind="stable")
    shown = _by_place(slices)
    rows, step, distance = [], [], []
    for one, other in pairwise(order):
        _, here, there = np.intersect1d(shown[one][0], shown[other][0], return_indices=True)
        if len(here) >= MIN_PIXELS:
            rows.append(np.eye(len(slices))[one] - np.eye(len(slices))[other])
            step.append(_usual(shown[one][1][here] - shown[other][1][there]))
            distance.append(int(slices.slice_index[other] - slices.slice_index[one]))
    if not step:
        return np.ones(len(slices))
    difference = np.stack(rows)
    deviation = max(MIN_GAIN_DEVIATION, float(np.median(np.abs(step))))
    weight = (deviation / DEVIATION) ** 2 / np.maximum(distance, 1.0)
    normal = difference.T @ (weight[:, None] * difference) + np.eye(len(slices))
    log_gain = solve(normal, difference.T @ (weight * np.array(step)), assume_a="pos")
    return np.asarray(np.exp(log_gain - log_gain.mean()))


def _by_place(slices: Slices) -> list[tuple[NDArray[np.int64], Float64Array]]:
    """For each slice the places of its masked pixels in the stack's plane, as numbers, and their log-intensities.

    Slices of one file share a lattice of pixels. Others may lie half a pixel apart. With an offset of a quarter neither
    is near the edge of a cell.
    """
    ((_, inside, world_mm, axes),) = stacks_by_header(slices)
    index = np.flatnonzero(inside)
    plane = slices.planes.plane_id()[index]
    place = world_mm[index] @ axes / slices.planes.spacing_mm[plane]
    column, row = np.floor(place - place.min(0) + 0.25).astype(np.int64).T
    value = slices.value[index].astype(np.float64)
    value = np.log(np.maximum(value, MIN_INTENSITY * value.mean()))
    number = column * (int(row.max()) + 1) + row
    return [(number[plane == k], value[plane == k]) for k in range(len(slices))]


def _usual(difference: Float64Array) -> float:
    """The most frequent difference: the centre of a Cauchy distribution of width `SCALE`."""
    centre = float(np.median(difference))
    for _ in range(MAX_ROUNDS):
        weight = 1 / (1 + ((difference - centre) / SCALE) ** 2)
        centre = float((weight * difference).sum() / weight.sum())
    return centre
