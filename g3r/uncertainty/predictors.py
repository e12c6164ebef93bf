"""Predictors of each voxel's error: what is known without the truth, independent of the intensity scale.

Intensities are normalised (the 99th percentile of V_coarse is 1), so that the same head with brighter pixels gives the
same predictors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_gradient_magnitude

from g3r.acquisition.coarse_volume import confidence
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import render
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box, on_grid
from g3r.run.on_demand import torch

RESIDUAL_VOXEL_MM = 1.6
RESIDUAL_SMOOTHING_MM = 1.6
"""Residuals are gathered on coarse voxels and smoothed, since the mean of a few noisy residuals is unreliable."""

RESIDUAL_SUPPORT = 0.1
"""Density (1 is one gapless stack) at which the local residual and that of the whole head have the same weight."""

EDGE_SIGMA_MM = 0.8
TEXTURE_SIGMA_MM = 2.0
"""Widths at which edges and fine detail of the volume are measured."""


def mean_residual(fit: SliceFit, grid: VolumeGrid, cutoff_sigma: float = CUTOFF_SIGMA) -> NDArray[np.float32]:
    """Mean absolute difference [I, J, K] of pixels and rendered slices around each voxel.

    Residuals are spread through the slices' PSF with the slice weights (the adjoint of the voxel operator), over the
    same with ones. Where few pixels reach, the value approaches the mean of the head.

    Args:
        fit: Gaussians and slices.
        grid: of the result.
        cutoff_sigma: where the Gaussians end.
    """
    slices, gain, weight = fit.slices, fit.gain, fit.weight
    log_gain = torch.from_numpy(np.log(gain).astype(np.float32))
    rendered = render(fit.cloud, slices.planes, log_gain=log_gain, cutoff_sigma=cutoff_sigma).numpy()
    if fit.bias_field:
        rendered = rendered * np.exp(StackBiasField(slices).log_field(np.array(fit.bias_field)))
    size = np.abs(slices.value - rendered)[slices.pixel_index] / gain[slices.pixel_plane]
    low, high = grid.world([0, 0, 0]), grid.world(np.array(grid.shape) - 1)
    coarse = VolumeGrid.isotropic(np.minimum(low, high), np.maximum(low, high), RESIDUAL_VOXEL_MM)
    operator = VoxelOperator(slices.planes, coarse, slices.pixel_index)
    covered = slices.pixel_volume_mm3 * weight / coarse.voxel_volume_mm3
    counted = covered[slices.pixel_plane].astype(np.float32)
    sigma = RESIDUAL_SMOOTHING_MM / RESIDUAL_VOXEL_MM
    density = gaussian_filter(operator.adjoint(counted), sigma)
    total = gaussian_filter(operator.adjoint((counted * size).astype(np.float32)), sigma)
    typical = np.float32((counted * size).sum() / max(counted.sum(), 1e-30))
    local = (total + RESIDUAL_SUPPORT * typical) / (density + RESIDUAL_SUPPORT)
    return on_grid(local, coarse, grid, outside=float(typical))


def gather_predictors(
    volume: NDArray[np.float32],
    mask: NDArray[np.bool_],
    grid: VolumeGrid,
    *,
    residual: NDArray[np.float32],
    density: NDArray[np.float32],
    prior: NDArray[np.float32],
    prior_share: NDArray[np.float32] | None,
) -> dict[str, NDArray[np.float64]]:
    """The predictors [n] of the n voxels of the mask, by name.

    Args:
        volume: [I, J, K] normalised intensities, as all intensities here.
        mask: [I, J, K] where predictors are wanted.
        grid: of all arrays.
        residual: [I, J, K] from `mean_residual`.
        density: [I, J, K] M_rho.
        prior: [I, J, K] the prior volume, or what the fit started from.
        prior_share: [I, J, K] in [0, 1]; None where no prior was used.

    Returns:
        `unmeasured` 1 - c; `prior_share`; `from_prior` |volume - prior|; `edge` gradient, per mm; `texture`
        deviation from the surroundings, root of its local mean square; `residual`; `depth_mm` below the rim
        of the mask.
    """
    spacing = grid.spacing_mm
    box = bounding_box(mask, margin=int(np.ceil(4 * TEXTURE_SIGMA_MM / spacing.min())))
    inside = mask[box]
    # outside the head the volume is zero; that edge is no edge of the brain, so the head is continued outwards
    image = _continued(np.asarray(volume[box], np.float32), inside)
    predictors: dict[str, NDArray[np.float64]] = {}

    def keep(name: str, values: NDArray[np.floating]) -> None:
        # one after the other: with fine voxels, each whole map is large
        predictors[name] = values[inside].astype(np.float64)

    keep("unmeasured", 1 - confidence(density[box]))
    keep("from_prior", np.abs(volume[box] - prior[box]))
    keep("edge", gaussian_gradient_magnitude(image, EDGE_SIGMA_MM / spacing) / spacing.mean())
    keep("texture", _local_deviation(image, TEXTURE_SIGMA_MM / spacing))
    keep("residual", residual[box])
    predictors["depth_mm"] = _depth_mm(inside, spacing)
    if prior_share is not None:
        keep("prior_share", prior_share[box])
    return predictors


def _local_deviation(image: NDArray[np.float32], sigma: NDArray[np.float64]) -> NDArray[np.float32]:
    """Root of the local mean square of the deviation from the surroundings."""
    detail = image - gaussian_filter(image, sigma)
    return np.sqrt(np.maximum(gaussian_filter(detail**2, sigma), 0))


def _depth_mm(inside: NDArray[np.bool_], spacing_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each voxel inside [n] to the nearest outside; beyond the edges of the array all is outside.

    It uses the transform's indices: to return distances, the transform takes six times their memory.
    """
    nearest = distance_transform_edt(
        np.pad(inside, 1), sampling=spacing_mm.tolist(), return_distances=False, return_indices=True
    )
    square = np.zeros(int(inside.sum()))
    for axis, here in enumerate(np.nonzero(inside)):
        there = nearest[axis, 1:-1, 1:-1, 1:-1][inside] - 1
        square += ((there - here) * spacing_mm[axis]) ** 2
    return np.sqrt(square)


def _continued(image: NDArray[np.float32], inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The image with the nearest value of the mask everywhere outside the mask."""
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return image[tuple(nearest)]
