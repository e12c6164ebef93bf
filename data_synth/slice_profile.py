"""Slice profiles of the simulator: how pixels average over the volume, in plane and through the slice.

Only the `gaussian` profile is that of the reconstruction model. With `box` and `sinc` a pixel averages over its own
area in plane: k-space that is filled up to the pixel's resolution passes all detail, whereas the model's Gaussian
halves the finest detail.

The volume is read by trilinear interpolation, which itself blurs. The sample positions are contracted to compensate,
so that the effective profile has the stated variance.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import sici

from g3r.acquisition.planes import Planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.voxel_operator import VoxelOperator, psf_nodes
from g3r.geometry import VolumeGrid

Array = NDArray[np.float64]
Profile = Literal["box", "gaussian", "sinc"]

SINC_LOBES = 2
"""Zero crossings on either side of the truncated sinc pulse of the `sinc` profile."""

SINC_REACH = 1.5
"""Distance at which the ripples of the `sinc` profile are cut off, in thicknesses from the centre of the slice."""

TRILINEAR_VARIANCE = 1.0 / 6.0
"""Mean variance that trilinear interpolation adds, in squared voxels: the mean of f (1 - f) over a voxel."""


class ProfileOperator(VoxelOperator):
    """The voxel operator with a slice profile of the simulator instead of the model's PSF.

    Args:
        planes: slices at their true poses.
        grid: of the volume.
        pixel_index: pixels to compute; None takes all.
        resolution_mm: in-plane pixel spacing.
        thickness_mm: slice thickness.
        profile: through the slice.
    """

    def __init__(
        self,
        planes: Planes,
        grid: VolumeGrid,
        pixel_index: NDArray[np.int64] | None,
        resolution_mm: float,
        thickness_mm: float,
        profile: Profile,
    ) -> None:
        super().__init__(planes, grid, pixel_index, (1, 1, 1))
        nodes, self.node_weight = profile_nodes(resolution_mm, thickness_mm, profile, float(grid.spacing_mm.mean()))
        self.node_mm = np.tile(nodes, (len(planes), 1, 1))
        self.move(planes)


def profile_nodes(resolution_mm: float, thickness_mm: float, profile: Profile, voxel_mm: float) -> tuple[Array, Array]:
    """Quadrature nodes and weights of a slice profile for a volume that is read by trilinear interpolation.

    Args:
        resolution_mm: in-plane pixel spacing.
        thickness_mm: slice thickness.
        profile: `gaussian` has the variance of the model's PSF; `box` is flat with soft edges; `sinc` is that of a
            truncated sinc pulse, steep with ripples. In plane `box` and `sinc` have the variance of a box of one pixel.
        voxel_mm: voxel size of the volume that is read.

    Returns:
        Sample positions [Q, 3] (mm in the slice's frame) and weights [Q]. The variance along each axis is that
        of the profile minus that of trilinear interpolation.
    """
    blur_mm2 = TRILINEAR_VARIANCE * voxel_mm**2
    target = psf_variance_mm2([resolution_mm] * 2, thickness_mm)
    if profile != "gaussian":
        target[:2] = resolution_mm**2 / 12
    axes = []
    for axis in range(3):
        reach = 5.2 * np.sqrt(target[axis])
        # in plane a pixel is about one voxel wide, so three positions are enough
        n = 3 if axis < 2 else 2 * int(np.ceil(reach / max(0.6, voxel_mm) / 2)) + 1
        if axis == 2 and profile == "box":
            nodes, weights, variance = _soft_box(n, thickness_mm)
        elif axis == 2 and profile == "sinc":
            nodes, weights, variance = _truncated_sinc(4 * n + 1, thickness_mm)
        else:
            nodes, weights = psf_nodes(n)
            variance = float(target[axis])
        axes.append((nodes * np.sqrt(max(variance - blur_mm2, 0.0)), weights))
    grid = np.stack(np.meshgrid(*[a[0] for a in axes], indexing="ij"), -1).reshape(-1, 3)
    return grid, np.einsum("i,j,k->ijk", *[a[1] for a in axes]).ravel()


def profile_deviation(profile: Profile) -> float:
    """Standard deviation of a profile through the slice, in units of the thickness."""
    if profile == "gaussian":
        return float(np.sqrt(psf_variance_mm2([1.0, 1.0], 1.0)[2]))
    shape = _soft_box if profile == "box" else _truncated_sinc
    return float(np.sqrt(shape(301, 1.0)[2]))


def _soft_box(n: int, thickness_mm: float) -> tuple[Array, Array, float]:
    """A profile that is flat inside the slice, with edges that fall over a fifth of the thickness.

    Returns:
        n nodes scaled to unit variance, their weights, and the profile's true variance in mm^2 (that of a box
        of the thickness convolved with one of a fifth of it).
    """
    nodes = np.linspace(-0.6, 0.6, n + 2)[1:-1]
    weights = np.clip((0.6 - np.abs(nodes)) / 0.2, 0.0, 1.0)
    weights /= weights.sum()
    return nodes / np.sqrt((weights * nodes**2).sum()), weights, thickness_mm**2 * (1 + 0.2**2) / 12


def _truncated_sinc(n: int, thickness_mm: float) -> tuple[Array, Array, float]:
    """The profile of a pulse that is a sinc cut off after `SINC_LOBES` zeros, for small flip angles.

    Returns:
        n nodes scaled to unit variance, their weights (those of ripples may be negative), and the variance in mm^2.

    Source: the profile is the Fourier transform of the pulse (Pauly et al., Journal of Magnetic Resonance 81, 1989);
        that of a truncated sinc is a difference of two sine integrals.
    """
    nodes = np.linspace(-SINC_REACH, SINC_REACH, n + 2)[1:-1]
    rising, falling = (sici(2 * np.pi * SINC_LOBES * (nodes + side))[0] for side in (0.5, -0.5))
    weights = (rising - falling) / (rising - falling).sum()
    variance = float((weights * nodes**2).sum())
    return nodes / np.sqrt(variance), weights, variance * thickness_mm**2
