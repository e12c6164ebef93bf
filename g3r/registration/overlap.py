"""Overlap of stacks: where they saw the same, so that they check each other's poses, and whether they agree there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.held_out import HELD_OUT_VOXEL_MM, coverage_without, volume_without
from g3r.registration.similarity import StackSamples
from g3r.registration.unseen import sampled


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """Agreement of stacks with the volumes of the others, only where those saw something.

    Args:
        seen_share: [K] share of each slice's masked pixels that other stacks saw.
        stack_share: the same share of each stack's masked pixels.
        correlation: of each stack with the volume of the others over the pixels that they saw, outline included.
    """

    seen_share: NDArray[np.float64]
    stack_share: list[float]
    correlation: list[float]


def overlap_of(slices: Slices, samples: list[StackSamples], motion: RigidPose) -> Overlap:
    """The overlap of two or more stacks in given poses.

    Args:
        slices: of all stacks.
        samples: the thinned pixels of each stack.
        motion: [K] world from header of all slices.
    """
    posed = slices.with_motion(motion)
    seen_share = np.zeros(len(slices))
    stack_share, correlations = [], []
    for sample in samples:
        own, pixels = motion.take(sample.rows), sample.pixels
        plane = np.repeat(np.arange(len(pixels)), np.diff(pixels.start))
        point = np.einsum("pij,pj->pi", own.rotation[plane], pixels.point_mm) + own.translation_mm[plane]
        share, coverage_grid = coverage_without(posed, sample.stack, HELD_OUT_VOXEL_MM)
        volume, grid = volume_without(posed, sample.stack, HELD_OUT_VOXEL_MM)
        seen = sampled(share, coverage_grid, point) > 0.5
        inside = pixels.value > 0
        n_inside = np.bincount(plane[inside], minlength=len(pixels))
        n_seen = np.bincount(plane[inside & seen], minlength=len(pixels))
        seen_share[sample.rows] = n_seen / np.maximum(n_inside, 1)
        stack_share.append(float(n_seen.sum() / max(int(n_inside.sum()), 1)))
        here, there = pixels.value[seen], sampled(volume, grid, point[seen])
        varies = len(here) > 1 and here.std() > 0 and there.std() > 0
        correlations.append(float(np.corrcoef(here, there)[0, 1]) if varies else 0.0)
    return Overlap(seen_share=seen_share, stack_share=stack_share, correlation=correlations)
