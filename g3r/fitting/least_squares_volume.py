"""The volume of the slices alone, without a network and without Gaussians: regularised least squares.

It stands for V_prior in `preview`, which writes it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.surroundings import without_surroundings
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.initial_volumes import InitialVolumes

SMOOTHNESS = 0.016
"""Weight of squared gradients over that of the pixels, lengths in units of what one pixel covers (the cube root of its
area times the thickness); chosen on two simulated heads of 0.8 x 0.8 x 2.2 mm."""

BRIGHTEST, CONTRADICTED = 0.999, 1.2
"""Quantile of the pixels that see brain alone, and how many times as bright brain may be: pixels at the rim that
would need more are of slices beside their place, where others saw none. They made a crust 2.6 times as bright."""

N_ITERATIONS = 8
"""Conjugate-gradient steps; more change less than 0.1 dB."""


def least_squares_volume(
    volumes: InitialVolumes, support: NDArray[np.bool_], gain: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Minimise sum_p w_p (A V - y)_p^2 + s ||grad V||^2, with what lies beside the brain taken out of the pixels.

    Slices have their nominal profile. Voxels beyond the brain are free: what the profile of a pixel at the rim reaches
    there is taken for brain.

    Args:
        volumes: of the slices in their poses; V_sharp is the start.
        support: [I, J, K] where there is brain, and a margin.
        gain: [K] intensity factors.
        weight: [K] slice weights.

    Returns:
        [I, J, K] on the grid of the volumes.
    """
    grid = volumes.grid
    slices, share = without_surroundings(volumes.slices, support, grid, gain, weight)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    covered_mm3 = float(np.median(slices.planes.spacing_mm.prod(1) * slices.thickness_mm))
    value, share = slices.masked_value / gain[slices.pixel_plane], share[slices.pixel_index]
    of_brain = value[share == 1]
    if len(of_brain):
        share = np.where(value > CONTRADICTED * np.quantile(of_brain, BRIGHTEST), 0, share)
    return solve_volume(
        operator,
        value.astype(np.float32),
        (weight[slices.pixel_plane] * share).astype(np.float32),
        start=volumes.sharp * support,
        n_iterations=N_ITERATIONS,
        smoothness=SMOOTHNESS * (covered_mm3 / grid.voxel_volume_mm3) ** (2 / 3),
    )
