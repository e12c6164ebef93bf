"""The volume of the slices alone, without a network and without Gaussians: least squares with total variation.

It stands for V_prior in `preview`, which writes it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.surroundings import without_surroundings
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.slice_targets import SliceModel
from g3r.fitting.voxel_problem import FitPixels, VoxelProblem, VoxelProblemSettings

SETTINGS = VoxelProblemSettings(hold=0.0, total_variation=0.007, tip=0.02, n_rounds=3, n_iterations=8, squares=0.3)
"""Chosen on development heads (docs/method.md, "A preview")."""

BRIGHTEST, CONTRADICTED = 0.999, 1.2
"""Quantile of the pixels that see brain alone, and how many times as bright brain may be. Pixels at the rim that would
need more belong to slices beside their place, where others saw nothing. They made a crust 2.6 times as bright."""


def least_squares_volume(
    volumes: InitialVolumes, support: NDArray[np.bool_], gain: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Minimise sum_p w_p (A V - y)_p^2 + s (|grad V| + q |grad V|^2), for pixels without what lies beside the brain.

    Slices have the profile of the fit. s follows their noise; pose errors of a single stack count as noise, since no
    other stack checks its poses. Voxels beyond the brain are free: what the profile of a rim pixel reaches there counts
    as brain.

    Args:
        volumes: of the slices in their poses, in normalised intensities; V_sharp is the start.
        support: [I, J, K] where there is brain, and a margin.
        gain: [K] intensity factors.
        weight: [K] slice weights.

    Returns:
        [I, J, K] on the grid of the volumes.
    """
    grid, start = volumes.grid, (volumes.sharp * support).astype(np.float32)
    slices, share = without_surroundings(volumes.slices, support, grid, gain, weight)
    index, plane = slices.pixel_index, slices.pixel_plane
    value, share = slices.value[index] / gain[plane], share[index]
    of_brain = value[share == 1]
    if len(of_brain):
        share = np.where(value > CONTRADICTED * np.quantile(of_brain, BRIGHTEST), 0, share)
    pixels = FitPixels(
        slices=SliceModel().applied(slices),
        index=index,
        plane=plane,
        value=value.astype(np.float32),
        weight=(weight[plane] * share).astype(np.float32),
    )
    noise = (pixels.error if slices.n_stacks == 1 else pixels.noise)(start, grid)
    return VoxelProblem(pixels, grid, SETTINGS.for_noise(noise)).solved(start)
