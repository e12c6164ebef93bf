"""Exhaustive search over the whole sphere of orientations, for a head or for the runs of one stack."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import VolumeGrid
from g3r.registration.normal_equations import correlation
from g3r.registration.placement import Placement, StackSamples, slice_costs
from g3r.registration.pose_samples import angle_deg, rotations_within, turns_about, uniform_rotations
from g3r.registration.segments import best_segments

N_ORIENTATIONS = 4000
"""Orientations that are tried; the nearest to any is about 10 degrees off."""

N_PEAKS = 4
PEAK_DISTANCE_DEG = 60.0
PEAK_MARGIN = 0.08
N_STACK_PEAKS = 10
STACK_PEAK_DISTANCE_DEG = 35.0
"""Orientations that are followed further: at most so many, at least so far apart, and no worse than the best
by more than this in correlation. One stack alone is more ambiguous than the whole head."""

SEGMENT_REACH_DEG = 70.0
SEGMENT_TRANSLATION_MM = 7.0
"""How far a run of slices may lie from its stack's orientation, and the lattice of shifts tried."""


def peaks(
    rotation: NDArray[np.float64],
    agreement: NDArray[np.float64],
    n_most: int = N_PEAKS,
    distance_deg: float = PEAK_DISTANCE_DEG,
) -> list[NDArray[np.float64]]:
    """The best of rotations [J, 3, 3] by agreement [J] that are far apart from each other, best first."""
    chosen: list[NDArray[np.float64]] = []
    for n in np.argsort(-agreement):
        if agreement[n] < agreement.max() - PEAK_MARGIN or len(chosen) == n_most:
            break
        if all(angle_deg(rotation[n], other) > distance_deg for other in chosen):
            chosen.append(rotation[n])
    return chosen


def stack_orientations(
    sample: StackSamples, target_mm: NDArray[np.float64], volume: NDArray[np.float32], grid: VolumeGrid
) -> list[NDArray[np.float64]]:
    """Orientations [3, 3] of a whole stack worth following, its centre taken to a target [3] (mm)."""
    rotation = uniform_rotations(N_ORIENTATIONS)
    motion = turns_about(rotation, sample.pixels.center_mm, target_mm)
    agreement = correlation(sample.pixels.moments(volume, grid, motion).sum(1))
    return peaks(rotation, agreement, N_STACK_PEAKS, STACK_PEAK_DISTANCE_DEG)


def place_around(
    sample: StackSamples,
    base: NDArray[np.float64],
    target_mm: NDArray[np.float64],
    volume: NDArray[np.float32],
    grid: VolumeGrid,
) -> Placement:
    """Runs of a stack on a lattice of motions around one orientation.

    Args:
        sample: the stack.
        base: [3, 3] orientation of the lattice's middle.
        target_mm: [3] where the stack's centre is taken to, give or take a shift.
        volume: [I, J, K].
        grid: its grid.
    """
    rotation = rotations_within(N_ORIENTATIONS, SEGMENT_REACH_DEG) @ base
    lattice = np.array(list(itertools.product((-SEGMENT_TRANSLATION_MM, 0.0, SEGMENT_TRANSLATION_MM), repeat=3)))
    candidate = turns_about(
        np.repeat(rotation, len(lattice), axis=0),
        sample.pixels.center_mm,
        target_mm + np.tile(lattice, (len(rotation), 1)),
    )
    cost = slice_costs(sample.pixels, volume, grid, candidate)
    segments = best_segments(cost, candidate, sample.slice_index, sample.pixels.center_mm)
    return Placement(candidate.take(segments.choice), segments)
