"""Prior share: how far each voxel of a result depends on the prior, by the response of the fit to a change of it.

If the prior had been wrong by some amount, how much of that would still be in the volume after the fit to the slices?
Rendered pixels are linear in the amplitudes, so the finished fit can answer this: the amplitudes are changed at random,
as another prior would have changed them, the slices stay as they are, and conjugate gradients remove what the slices
contradict. The share of the change that remains is the prior share.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.coarse_volume import confidence
from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import GaussianCloud, render, solve_amplitudes
from g3r.gaussians.amplitudes import MAX_PROJECTION_BYTES
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.run.on_demand import torch

N_PROBES = 2
PROBE_VOXEL_MM = 1.6
SMOOTHING_MM = 3.2
"""Responses are compared on coarse voxels, in neighbourhoods that hold some dozen Gaussians."""

ANSWER_ITERATIONS = 20
ANSWER_DAMPING = 0.01
"""Conjugate-gradient steps, and pull towards the changed amplitudes, with which the response is that of the whole fit:
checked by changing the prior volume itself and fitting again (tests/uncertainty/test_prior_share.py)."""


def estimate_prior_share(
    fit: SliceFit,
    *,
    density: NDArray[np.float32],
    density_grid: VolumeGrid,
    mask: NDArray[np.bool_],
    grid: VolumeGrid,
    rng: np.random.Generator,
    n_probes: int = N_PROBES,
    cutoff_sigma: float = CUTOFF_SIGMA,
    projection_bytes: int = MAX_PROJECTION_BYTES,
) -> NDArray[np.float32]:
    """Prior share of each voxel of the result, from 0 (the slices decide) to 1 (the prior alone).

    With r the share of a change of the prior that the fit to the slices leaves in the result, and
    c = 1 - exp(-M_rho) the confidence, the result is the larger of r and (1 - c)^2: Gaussians continue what the slices
    determine a little beyond them, where r is low, but a voxel that nothing measured depends on the prior in any case.
    The square is how r falls with coverage where slices are evenly spaced. Shapes, poses, gains and slice weights are
    those of the finished fit.

    Args:
        fit: of stage 2.
        density: M_rho on `density_grid`.
        density_grid: its grid.
        mask: [I, J, K] on `grid`; the result is 1 outside, where nothing was fitted.
        grid: of the result.
        rng: draws the changes.
        n_probes: number of random changes; the responses are averaged.
        cutoff_sigma: where the fit's Gaussians end.
        projection_bytes: see `solve_amplitudes`.

    Returns:
        [I, J, K] float32 in [0, 1].
    """
    unseen = 1 - on_grid(confidence(density), density_grid, grid, outside=0.0)
    remaining = remaining_share(
        fit, grid, rng=rng, n_probes=n_probes, cutoff_sigma=cutoff_sigma, projection_bytes=projection_bytes
    )
    left = on_grid(remaining, _coarse(grid), grid, outside=1.0)
    share = np.maximum(np.clip(left, 0, 1), np.clip(unseen, 0, 1) ** 2)
    return np.where(mask, share, 1.0).astype(np.float32)


def remaining_share(
    fit: SliceFit,
    grid: VolumeGrid,
    *,
    rng: np.random.Generator,
    n_probes: int = N_PROBES,
    cutoff_sigma: float = CUTOFF_SIGMA,
    projection_bytes: int = MAX_PROJECTION_BYTES,
) -> NDArray[np.float32]:
    """r: how much of a random change of the amplitudes the slices leave in place, on a coarse grid over `grid`.

    The local regression of what is left on what was put in, <left, put in> / <put in, put in>, with means
    over a Gaussian neighbourhood and all probes; 1 where no Gaussian reaches.

    Args:
        fit: of stage 2.
        grid: of the result.
        rng: draws the changes.
        n_probes: number of random changes.
        cutoff_sigma: where the fit's Gaussians end.
        projection_bytes: see `solve_amplitudes`.
    """
    slices, coarse = fit.slices, _coarse(grid)
    planes, sampling = slices.planes, volume_planes(coarse)
    slice_weight = slices.mask * fit.weight[planes.plane_id()]
    nothing = np.zeros(planes.n_pixels, np.float32)
    sigma = SMOOTHING_MM / coarse.spacing_mm
    together, square = np.zeros(coarse.shape), np.zeros(coarse.shape)

    def volume(cloud: GaussianCloud) -> NDArray[np.float32]:
        return volume_from_pixels(render(cloud, sampling, cutoff_sigma=cutoff_sigma).numpy(), coarse)

    for _ in range(n_probes):
        change = torch.from_numpy(rng.standard_normal(len(fit.cloud)).astype(np.float32))
        probe = fit.cloud.with_amplitude(change)
        response = solve_amplitudes(
            probe,
            planes,
            nothing,
            slice_weight.astype(np.float32),
            gain=fit.gain,
            n_iterations=ANSWER_ITERATIONS,
            damping=ANSWER_DAMPING,
            cutoff_sigma=cutoff_sigma,
            projection_bytes=projection_bytes,
        )
        put_in, left = volume(probe), volume(response)
        together += gaussian_filter(left * put_in, sigma)
        square += gaussian_filter(put_in**2, sigma)
    floor = 1e-3 * float(square.max(initial=0))
    reached = square > floor
    return np.where(reached, together / np.where(reached, square, 1), 1).astype(np.float32)


def _coarse(grid: VolumeGrid) -> VolumeGrid:
    """Coarse voxels over all of a grid, of at least its own size."""
    corners = grid.world(grid.corner_index)
    voxel_mm = max(PROBE_VOXEL_MM, float(grid.spacing_mm.max()))
    return VolumeGrid.isotropic(corners.min(0), corners.max(0), voxel_mm, voxel_mm)
