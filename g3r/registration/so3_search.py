"""Exhaustive search over SO(3): orientations of a head or of one stack, and motion segments around them."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import VolumeGrid
from g3r.registration.motion_segments import best_segments
from g3r.registration.placement import Placement
from g3r.registration.pose_sampling import angle_deg, rotations_about, rotations_within, uniform_rotations
from g3r.registration.similarity import StackSamples, correlation, slice_costs

N_ORIENTATIONS = 4000
"""Number of orientations that are tried; any orientation is within about 10 degrees of one of them."""

N_FOLLOWED, DISTANCE_DEG = 4, 60.0
N_FOLLOWED_OF_STACK, STACK_DISTANCE_DEG = 10, 35.0
CORRELATION_MARGIN = 0.08
"""Limits for the orientations that are followed: their largest number, the least angle between two of them, and by how
much their correlation may be below the best. One stack alone is more ambiguous than the whole head."""

SEGMENT_REACH_DEG = 70.0
SEGMENT_TRANSLATION_MM = 7.0
"""Largest angle of a motion segment to its stack's orientation, and step of the lattice of translations."""


def best_orientations(
    rotation: NDArray[np.float64],
    agreement: NDArray[np.float64],
    n_most: int = N_FOLLOWED,
    distance_deg: float = DISTANCE_DEG,
) -> list[NDArray[np.float64]]:
    """The rotations with the highest correlation that are far from each other, best first.

    Args:
        rotation: [J, 3, 3].
        agreement: [J] correlation of each.
        n_most: how many at most.
        distance_deg: angle between any two of them.
    """
    chosen: list[NDArray[np.float64]] = []
    for n in np.argsort(-agreement):
        if agreement[n] < agreement.max() - CORRELATION_MARGIN or len(chosen) == n_most:
            break
        if all(angle_deg(rotation[n], other) > distance_deg for other in chosen):
            chosen.append(rotation[n])
    return chosen


def stack_orientations(
    sample: StackSamples, target_mm: NDArray[np.float64], volume: NDArray[np.float32], grid: VolumeGrid
) -> list[NDArray[np.float64]]:
    """Orientations [3, 3] of one stack worth following, best first.

    Args:
        sample: the stack.
        target_mm: [3] where its centre is taken.
        volume: [I, J, K].
        grid: its grid.
    """
    rotation = uniform_rotations(N_ORIENTATIONS)
    motion = rotations_about(rotation, sample.pixels.center_mm, target_mm)
    agreement = correlation(sample.pixels.moments(volume, grid, motion).sum(1))
    return best_orientations(rotation, agreement, N_FOLLOWED_OF_STACK, STACK_DISTANCE_DEG)


def place_around(
    sample: StackSamples,
    base: NDArray[np.float64],
    target_mm: NDArray[np.float64],
    volume: NDArray[np.float32],
    grid: VolumeGrid,
) -> Placement:
    """Motion segments of a stack, chosen from a lattice of motions around one orientation.

    Args:
        sample: the stack.
        base: [3, 3] orientation in the middle of the lattice.
        target_mm: [3] where the stack's centre is taken, up to a translation of the lattice.
        volume: [I, J, K].
        grid: its grid.
    """
    rotation = rotations_within(N_ORIENTATIONS, SEGMENT_REACH_DEG) @ base
    lattice = np.array(list(itertools.product((-SEGMENT_TRANSLATION_MM, 0.0, SEGMENT_TRANSLATION_MM), repeat=3)))
    candidate = rotations_about(
        np.repeat(rotation, len(lattice), axis=0),
        sample.pixels.center_mm,
        target_mm + np.tile(lattice, (len(rotation), 1)),
    )
    cost = slice_costs(sample.pixels, volume, grid, candidate)
    segments = best_segments(cost, candidate, sample.slice_index, sample.pixels.center_mm)
    return Placement(candidate.take(segments.choice), segments)
