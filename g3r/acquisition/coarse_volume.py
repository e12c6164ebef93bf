"""Coarse volume and physical density by PSF accumulation (G3R Eq. 6)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

DENSITY_CONVENTION = "dimensionless-whole-slice-v2"
"""Density M: 1 where one gapless stack covers once; see `coarse_and_density`."""

INTENSITY_CONVENTION = "p99-coarse-v1"
"""The 99th percentile of V_coarse, over voxels with M above 0.1, is one; see `normalisation_scale`."""

SUPPORT_DENSITY = 1e-3
"""V_coarse is zero below this density, where nothing was measured."""


def coarse_and_density(
    slices: Slices,
    grid: VolumeGrid,
    gain: NDArray[np.floating] | None = None,
    weight: NDArray[np.floating] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """V_coarse and M_rho: pixels accumulated through their PSF on a grid (G3R Eq. 6).

    A pixel counts with the volume that it covers, its area times the slice *thickness*. M is the sum of these
    volumes, spread by the unit-integral PSF, divided by the volume of a voxel: dimensionless, 1 where one
    gapless stack covers once, whatever the pixel size and the grid. (Eq. 6 as printed has the unit 1/mm. With
    the slice spacing instead of the thickness a gap would add density; for gapless stacks both agree.)

    Args:
        slices: K slices.
        grid: where to accumulate.
        gain: [K] intensity factor of each slice, divided out.
        weight: [P'] of each masked pixel, from 0 to 1; scales its density and its influence.

    Returns:
        V_coarse (zero where M < 1e-3) and M_rho, both [I, J, K] float32.

    Source: G3R Eq. 6, made dimensionless (docs/method.md).
    """
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index, _psf_points(slices, grid))
    covered = (slices.pixel_volume_mm3 / grid.voxel_volume_mm3)[slices.pixel_plane]
    if weight is not None:
        covered = covered * weight
    value = slices.masked_value_without(gain)
    density = operator.adjoint(covered.astype(np.float32))
    numerator = operator.adjoint((covered * value).astype(np.float32))
    supported = density > SUPPORT_DENSITY
    coarse = np.divide(numerator, density, out=np.zeros_like(numerator), where=supported)
    return coarse, density


def _psf_points(slices: Slices, grid: VolumeGrid) -> tuple[int, int, int]:
    """Quadrature nodes no further apart than a voxel, so that scattering leaves no holes."""
    voxel = float(grid.spacing_mm.min())
    sigma = np.sqrt(slices.planes.psf_var_mm2.max(0))

    def odd(reach_mm: float) -> int:
        return 2 * max(1, math.ceil(reach_mm / voxel / 2)) + 1

    return odd(2.4 * sigma[0]), odd(2.4 * sigma[1]), min(odd(5.2 * sigma[2]), 31)


def confidence(density: NDArray[np.floating]) -> NDArray[np.floating]:
    """Confidence c = 1 - exp(-M) in [0, 1) of density M, without loss of digits at small M."""
    return -np.expm1(-density)


def normalisation_scale(coarse: NDArray[np.floating], density: NDArray[np.floating]) -> float:
    """The intensity that becomes 1: the 99th percentile of V_coarse where M is above 0.1.

    Raises:
        InputError: no voxel is covered, or the percentile is not positive.
    """
    covered = coarse[density > 0.1]
    if covered.size == 0:
        raise InputError("no voxel is covered by a slice; check masks and headers")
    scale = float(np.percentile(covered, 99))
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"99th percentile of the image inside the masks is {scale:g}; expected a positive value")
    return scale
