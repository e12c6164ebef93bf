"""Placing the slices of one stack, motion segment by motion segment, in a volume made without them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.motion_segments import Segments, best_segments
from g3r.registration.pose_sampling import distinct, perturbed
from g3r.registration.similarity import StackSamples, slice_costs


@dataclass(frozen=True)
class Placement:
    """Motions [K] of a stack's slices (world from header), and the segments that they form."""

    motion: RigidPose
    segments: Segments


def refine_placement(
    sample: StackSamples,
    motion: RigidPose,
    volume: NDArray[np.float32],
    grid: VolumeGrid,
    *,
    rotation_deg: float,
    translation_mm: float,
    rng: np.random.Generator,
    proposals: RigidPose | None = None,
) -> Placement:
    """Try many motions around the present ones for every slice of a stack, and choose segments.

    A wrongly placed segment can take the motion of any other segment, or a random one near it; it need not be known
    which segments are wrong.

    Args:
        sample: the stack.
        motion: [K] present motions (world from header).
        volume: [I, J, K] made without this stack.
        grid: its grid.
        rotation_deg: standard deviation of random rotation vectors per axis.
        translation_mm: standard deviation of random translations per axis.
        rng: source of randomness.
        proposals: further motions, such as those of another initialisation.
    """
    center = sample.pixels.center_mm
    present = distinct(motion, center)
    known = present if proposals is None else RigidPose.concatenated([present, proposals])
    n_each = max(10, sample.n_candidates // len(known))
    candidate = perturbed(known, center, n_each, rotation_deg, translation_mm, rng)
    cost = slice_costs(sample.pixels, volume, grid, candidate)
    segments = best_segments(cost, candidate, sample.slice_index, center, keep=np.arange(len(known)))
    return Placement(candidate.take(segments.choice), segments)
