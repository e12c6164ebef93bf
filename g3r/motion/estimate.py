"""Motion, first version: stacks one after the other, then all slices against the volume, coarse to fine."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid
from g3r.geometry.rigid import fit_rigid
from g3r.motion.normal_equations import SliceModel
from g3r.motion.slice_registration import register_slices, try_neighbours
from g3r.motion.stack_registration import register_stacks
from g3r.motion.volume import grid_around, solve_volume

logger = logging.getLogger(__name__)


HEADER_REACH_MM = 2.0
"""Slices further than this from the common motion hardly take part in finding it."""


@dataclass(frozen=True)
class MotionSettings:
    """How long to search.

    Args:
        stacks: register stacks to each other first.
        n_rounds: alternations of volume and slices; 0 keeps the slices where the stacks are.
        steps_per_round: Gauss-Newton steps of the slices in a round.
        finest_voxel_mm: voxel of the last rounds.
        pixels_at_most: masked pixels in use; larger subjects are thinned on coarse levels.
    """

    stacks: bool = True
    n_rounds: int = 12
    steps_per_round: int = 5
    finest_voxel_mm: float = 1.2
    pixels_at_most: int = 400_000


@dataclass(frozen=True)
class MotionEstimate:
    """Slices in estimated poses with gain [K], trust [K] in (0, 1] and correlation [K] with the volume.

    stack_agreement: correlation of each stack when it was registered; history: one line of figures a round.
    """

    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    stack_agreement: list[float]
    history: list[dict[str, float]]


def estimate_motion(
    slices: Slices, settings: MotionSettings, progress: Callable[[int, int], None] = lambda done, total: None
) -> MotionEstimate:
    """Poses of all slices, from their header poses.

    Args:
        slices: intensities of order one (the 99th percentile near 1).
        settings: how long to search.
        progress: called with (rounds done, rounds in all).
    """
    agreement = [1.0] * len(np.unique(slices.stack_id))
    if settings.stacks:
        slices, agreement = register_stacks(slices)
    gain = np.ones(len(slices))
    weight = np.ones(len(slices))
    volume: NDArray[np.float32] | None = None
    grid: VolumeGrid | None = None
    history: list[dict[str, float]] = []
    n_rounds = settings.n_rounds
    for number in range(n_rounds):
        progress(number, n_rounds)
        fraction = number / max(1, n_rounds - 1)
        # coarse to fine: the capture range is about a voxel of the volume's blur
        voxel = settings.finest_voxel_mm * (2.4 if fraction < 0.34 else 1.6 if fraction < 0.75 else 1.0)
        smoothness = 0.3 if fraction < 0.2 else 0.1 if fraction < 0.5 else 0.03
        if grid is None or not np.isclose(grid.spacing_mm[0], voxel):
            grid, volume = grid_around(slices, voxel), None
        stride = max(
            1, round(len(slices.pixel_index) / settings.pixels_at_most * (voxel / settings.finest_voxel_mm))
        )
        volume = _volume_of(slices, grid, gain, weight, volume, smoothness, stride)
        model = SliceModel(slices, volume, grid, stride=stride)
        residual = model.residuals(slices.planes, gain)
        width = 2 * 1.4826 * float(np.median(np.abs(residual))) + 1e-6
        moved = 0
        if 0.1 < fraction < 0.8:
            slices, moved = try_neighbours(model, slices, gain, width=width)
        slices, gain, fit = register_slices(
            model, slices, gain, n_steps=settings.steps_per_round, width=width
        )
        weight = slice_weights(fit.loss)
        history.append(
            {"round": number, "voxel_mm": voxel, "residual": width / 2,
             "median_ncc": float(np.median(fit.ncc)), "moved": moved}
        )  # fmt: skip
        logger.info(
            "slices, round %d: voxel %.1f mm, residual %.4f, moved %d", number + 1, voxel, width / 2, moved
        )
    progress(n_rounds, n_rounds)
    slices = centred_on_headers(slices)
    ncc = _final_ncc(slices, gain, weight, settings)
    return MotionEstimate(slices, gain, weight, ncc, agreement, history)


def centred_on_headers(slices: Slices) -> Slices:
    """Take out the motion that all slices share, as their headers see it.

    Poses are determined up to one rigid motion of the whole head. This choice keeps the volume where the
    scanner's coordinates say it is, on (robust) average over all slices.
    """
    corners = np.array([[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    size_mm = slices.planes.shape * slices.planes.spacing_mm
    half = np.pad(size_mm / 2, ((0, 0), (0, 1)))
    local = half[:, None, :] * corners
    here = slices.planes.pose.apply(local).reshape(-1, 3)
    header = slices.header_pose.apply(local).reshape(-1, 3)
    area = np.repeat(size_mm.prod(1), len(corners))
    weight = area
    for _ in range(10):
        back = fit_rigid(here, header, weight)
        away_mm = np.linalg.norm(back.apply(here[None])[0] - header, axis=1)
        weight = area / (1 + (away_mm / HEADER_REACH_MM) ** 2)
    return slices.with_pose(back @ slices.planes.pose)


def slice_weights(loss: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trust in each slice [K], going down smoothly where its mean robust loss stands out.

    1 up to the median plus twice the robust spread, then the Geman-McClure form; never zero.
    """
    median = np.median(loss)
    spread = 1.4826 * np.median(np.abs(loss - median)) + 0.05 * median + 1e-12
    excess = np.maximum(0.0, (loss - median) / spread - 2.0)
    return np.maximum(1.0 / (1.0 + (excess / 2.0) ** 2) ** 2, 1e-3)


def _volume_of(
    slices: Slices,
    grid: VolumeGrid,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    start: NDArray[np.float32] | None,
    smoothness: float,
    stride: int,
) -> NDArray[np.float32]:
    index = slices.pixel_index[::stride]
    operator = VoxelOperator(slices.planes, grid, index, (1, 1, 5))
    value = slices.value[index] / gain[operator.plane]
    pixel_weight = weight[operator.plane].astype(np.float32)
    if start is not None:  # pixels far from the present volume (spikes, signal loss) count less
        residual = value - operator.forward(start)
        width = 3 * 1.4826 * float(np.median(np.abs(residual))) + 1e-6
        pixel_weight = (pixel_weight / (1 + (residual / width) ** 2)).astype(np.float32)
    return solve_volume(
        operator, value.astype(np.float32), pixel_weight, start=start, n_iterations=8, smoothness=smoothness
    )


def _final_ncc(
    slices: Slices, gain: NDArray[np.float64], weight: NDArray[np.float64], settings: MotionSettings
) -> NDArray[np.float64]:
    grid = grid_around(slices, settings.finest_voxel_mm)
    volume = _volume_of(slices, grid, gain, weight, None, 0.03, 1)
    return SliceModel(slices, volume, grid).evaluate(slices.planes, gain, 1.0).ncc
