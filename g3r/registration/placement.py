"""Placing the slices of one stack, run by run, in a volume that they did not help to make."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.normal_equations import correlation
from g3r.registration.pose_samples import SearchPixels, distinct, mean_square_residual, perturbed
from g3r.registration.segments import Segments, best_segments, changes_in_time, transition_penalty

CORRELATION_AREA_MM2 = 80.0
"""Area over which residuals at a search's resolution are alike: one independent sample per so much slice."""

N_CANDIDATES = 4000

PIXELS_OF_A_VOLUME = 100_000


@dataclass(frozen=True)
class StackSamples:
    """One stack as a search sees it: its thinned pixels by the header, and its slices' numbers.

    Args:
        stack: number of the stack.
        rows: [K] which of all slices these are.
        pixels: at the header poses.
        slice_index: [K].
        n_candidates: random motions tried for the stack in one go.
    """

    stack: int
    rows: NDArray[np.int64]
    pixels: SearchPixels
    slice_index: NDArray[np.int64]
    n_candidates: int = N_CANDIDATES

    @classmethod
    def of_all(cls, slices: Slices, n_candidates: int = N_CANDIDATES) -> list[StackSamples]:
        """An entry for each stack."""
        by_header = slices.with_pose(slices.header_pose)
        samples = []
        for stack in np.unique(slices.stack_id):
            rows = np.flatnonzero(slices.stack_id == stack)
            pixels = SearchPixels.of(by_header.take(rows))
            samples.append(cls(int(stack), rows, pixels, slices.slice_index[rows], n_candidates))
        return samples


@dataclass(frozen=True)
class Placement:
    """Motions [K] of a stack's slices (world from header), the runs they form, and what they cost."""

    motion: RigidPose
    segments: Segments


def slice_costs(
    pixels: SearchPixels, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose
) -> NDArray[np.float64]:
    """Negative log likelihood [K, J] of slices k in a volume under motions j.

    Student's form with the noise level of a slice that fits: a slice with signal loss says less, not more.
    """
    residual = mean_square_residual(pixels.moments(volume, grid, motion)).T
    noise = float(np.median(residual.min(1))) + 1e-12
    n_samples = pixels.area_mm2 / CORRELATION_AREA_MM2
    return n_samples[:, None] * np.log1p(residual / (2 * noise))


def own_moments(
    pixels: SearchPixels, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose
) -> NDArray[np.float64]:
    """Sums n, y, m, yy, mm, ym [K, 6] of each slice in a volume under its own motion [K]."""
    point = np.empty_like(pixels.point_mm)
    for k in range(len(pixels)):
        of_slice = slice(pixels.start[k], pixels.start[k + 1])
        point[of_slice] = pixels.point_mm[of_slice] @ motion.rotation[k].T + motion.translation_mm[k]
    return replace(pixels, point_mm=point).moments(volume, grid, RigidPose.identity(1))[0]


@dataclass(frozen=True)
class Prediction:
    """How well a volume predicts the slices of a stack that did not help to make it.

    Args:
        cost: of the slices (n log residual, the noise being unknown) and of their movements; comparable
            between placements of the same stack.
        correlation: over all pixels, outline included.
        slice_correlation: [K].
    """

    cost: float
    correlation: float
    slice_correlation: NDArray[np.float64]


def predict(
    sample: StackSamples, motion: RigidPose, volume: NDArray[np.float32], grid: VolumeGrid, interleave: int
) -> Prediction:
    """Compare a stack with a volume under given motions [K] (world from header)."""
    moments = own_moments(sample.pixels, volume, grid, motion)
    energy = moments[:, 3] / moments[:, 0]
    relative = mean_square_residual(moments) / np.maximum(energy, 1e-30)
    fit = (sample.pixels.area_mm2 / CORRELATION_AREA_MM2) @ np.log(relative + 1e-4)
    moves = changes_in_time(motion, sample.slice_index, sample.pixels.center_mm, interleave)
    return Prediction(float(fit) + transition_penalty(moves), float(correlation(moments.sum(0))), correlation(moments))


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
    """Offer every slice of a stack many motions around those of the stack's slices, and choose runs.

    A run that lies wrongly can so take the place of any other run, or a random one near it; nothing has to
    be known about which runs lie wrongly.

    Args:
        sample: the stack.
        motion: [K] present motions (world from header).
        volume: [I, J, K] made without this stack.
        grid: its grid.
        rotation_deg: standard deviation per axis of random turns.
        translation_mm: and of random shifts.
        rng: source of randomness.
        proposals: further motions to be tried as they are, such as those of another method.
    """
    center = sample.pixels.center_mm
    present = distinct(motion, center)
    if proposals is not None:
        known = RigidPose(
            np.concatenate([present.rotation, proposals.rotation]),
            np.concatenate([present.translation_mm, proposals.translation_mm]),
        )
    else:
        known = present
    n_each = max(10, sample.n_candidates // len(known))
    candidate = perturbed(known, center, n_each, rotation_deg, translation_mm, rng)
    cost = slice_costs(sample.pixels, volume, grid, candidate)
    segments = best_segments(cost, candidate, sample.slice_index, center, keep=np.arange(len(known)))
    return Placement(candidate.take(segments.choice), segments)


def volume_without(
    slices: Slices, stack: int | None, spacing_mm: float, smoothness: float = 0.1
) -> tuple[NDArray[np.float32], VolumeGrid]:
    """A volume from all slices but those of one stack, zero outside the masks; and its grid.

    A slice registers to its own blur if it helped to make the volume.

    Args:
        slices: all slices at their present poses.
        stack: the one left out; None takes all.
        spacing_mm: voxel size.
        smoothness: see `solve_volume`.
    """
    others = slices if stack is None else slices.take(slices.stack_id != stack)
    grid = grid_around(others, spacing_mm, margin_mm=20.0)
    index = np.arange(0, others.planes.n_pixels, max(1, others.planes.n_pixels // PIXELS_OF_A_VOLUME))
    operator = VoxelOperator(others.planes, grid, index, (1, 1, 3))
    value = np.where(others.mask[index], others.value[index], 0).astype(np.float32)
    weight = np.ones(len(index), np.float32)
    volume = solve_volume(operator, value, weight, n_iterations=6, smoothness=smoothness)
    return gaussian_filter(volume, 0.5), grid
