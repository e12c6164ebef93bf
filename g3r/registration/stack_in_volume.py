"""Placement of a stack in a finished volume that it did not help to make: the whole stack first, then its slices.

The steps are those of registration: an exhaustive search of orientations where the headers do not agree,
motion segments, and Levenberg-Marquardt for every slice, coarse to fine.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.acquisition.smooth_fill import smooth_fill
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.grid import bounding_box, on_grid
from g3r.registration.held_out import HELD_OUT_VOXEL_MM, predict
from g3r.registration.motion_segments import estimate_interleave
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.placement import refine_placement
from g3r.registration.similarity import StackSamples
from g3r.registration.slice_registration import register_slices
from g3r.registration.so3_search import place_around, stack_orientations
from g3r.registration.thresholds import IN_PLACE_CORRELATION

logger = logging.getLogger(__name__)

SEARCH_ROUNDS = ((8.0, 4.0), (5.0, 3.0), (3.0, 2.0), (2.0, 1.5))
"""Random rotations (degrees) and translations (mm) of the rounds of motion segments."""

BLUR_MM = (1.5, 0.7, 0.0)
"""Standard deviations of the volume's blur while slices are registered; the capture range is about the first one."""

N_STEPS = 8


def place_in_volume(
    slices: Slices, volume: NDArray[np.float32], grid: VolumeGrid, rng: np.random.Generator
) -> tuple[Slices, float]:
    """Find the pose of every slice of a stack in a volume.

    Args:
        slices: K slices of one stack at their header poses, intensities of order one.
        volume: [I, J, K] in the slices' intensities, zero where it shows nothing.
        grid: its grid.
        rng: source of randomness.

    Returns:
        The slices in their poses, and the correlation of the stack as placed by the search.
    """
    (sample,) = StackSamples.of_all(slices)
    coarse, coarse_grid = _coarse(volume, grid)
    motion, correlation = _searched(sample, coarse, coarse_grid, rng)
    slices = slices.with_motion(motion)
    gain = np.ones(len(slices))
    # with zeros beyond what the volume shows, a slice that it shows only in part would move inwards
    continued = smooth_fill(volume, (volume != 0).astype(np.float32))
    for sigma_mm in BLUR_MM:
        blurred = gaussian_filter(continued, sigma_mm / grid.spacing_mm) if sigma_mm else continued
        model = SampledSlices(slices, blurred, grid)
        width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
        slices, gain, _ = register_slices(model, slices, gain, n_steps=N_STEPS, width=width)
    return slices, correlation


def _coarse(volume: NDArray[np.float32], grid: VolumeGrid) -> tuple[NDArray[np.float32], VolumeGrid]:
    """The volume blurred as thick slices are, in voxels of the search."""
    head = bounding_box(volume != 0)
    inside = grid.cropped(head)
    corners = inside.world(inside.corner_index)
    coarse_grid = VolumeGrid.isotropic(corners.min(0), corners.max(0), HELD_OUT_VOXEL_MM, 2 * HELD_OUT_VOXEL_MM)
    blurred = gaussian_filter(volume, HELD_OUT_VOXEL_MM / 2 / grid.spacing_mm)
    return on_grid(blurred, grid, coarse_grid, 0.0), coarse_grid


def _searched(
    sample: StackSamples, volume: NDArray[np.float32], grid: VolumeGrid, rng: np.random.Generator
) -> tuple[RigidPose, float]:
    """Motions [K] of a stack by the search, and their correlation: starts at the headers, then at any orientation."""
    best: tuple[float, float, RigidPose] | None = None
    weight = volume.clip(0)
    target_mm = grid.world(np.argwhere(weight > 0)).T @ weight[weight > 0] / weight.sum()
    for motion in _starts(sample, target_mm, volume, grid):
        for rotation_deg, translation_mm in SEARCH_ROUNDS:
            placement = refine_placement(
                sample, motion, volume, grid, rotation_deg=rotation_deg, translation_mm=translation_mm, rng=rng
            )
            motion = placement.motion
        interleave = estimate_interleave(motion, sample.slice_index, sample.pixels.center_mm)
        found = predict(sample, motion, volume, grid, interleave)
        logger.debug("a start: cost %.0f, correlation %.2f", found.cost, found.correlation)
        if best is None or found.cost < best[0]:
            best = found.cost, found.correlation, motion
        if best[1] > IN_PLACE_CORRELATION:
            break
    assert best is not None
    return best[2], best[1]


def _starts(
    sample: StackSamples, target_mm: NDArray[np.float64], volume: NDArray[np.float32], grid: VolumeGrid
) -> Iterator[RigidPose]:
    """Motions to start from: the headers, the headers with the centres of both heads aligned, and any orientation."""
    still = RigidPose.identity(len(sample.slice_index))
    yield still
    yield RigidPose(still.rotation, still.translation_mm + target_mm - sample.pixels.center_mm)
    for base in stack_orientations(sample, target_mm, volume, grid):
        yield place_around(sample, base, target_mm, volume, grid).motion
