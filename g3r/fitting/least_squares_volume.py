"""The volume of the slices alone, without a network and without Gaussians: regularised least squares.

It stands for V_prior where no network is used, and is what `preview` writes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.surroundings import without_surroundings
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.slice_targets import SliceModel

SMOOTHNESS_MM2 = 0.03
"""Weight of squared gradients over that of the pixels, chosen on two simulated heads."""

N_ITERATIONS = 8
"""Conjugate-gradient steps; more change less than 0.1 dB."""


def least_squares_volume(
    volumes: InitialVolumes, gain: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Minimise sum_p w_p (A V - y)_p^2 + s ||grad V||^2, with what lies beside the brain taken out of the pixels.

    Slices have the profile of the fit. Voxels beyond the brain are free: what the profile of a pixel at the rim reaches
    there is taken for brain.

    Args:
        volumes: of the slices in their poses; V_sharp is the start.
        gain: [K] intensity factors.
        weight: [K] slice weights.

    Returns:
        [I, J, K] on the grid of the volumes.
    """
    grid, support = volumes.grid, volumes.foreground.support()
    modelled = SliceModel().applied(volumes.slices)
    slices, share = without_surroundings(modelled, support, grid, gain, weight)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    return solve_volume(
        operator,
        (slices.masked_value / gain[slices.pixel_plane]).astype(np.float32),
        (weight[slices.pixel_plane] * share[slices.pixel_index]).astype(np.float32),
        start=volumes.sharp * support,
        n_iterations=N_ITERATIONS,
        smoothness=SMOOTHNESS_MM2 / float(grid.spacing_mm.prod()) ** (2 / 3),
    )
