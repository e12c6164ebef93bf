"""Densification where a residual is large, pruning and merging where Gaussians hardly matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from g3r.gaussians.cloud import GaussianCloud
from g3r.geometry import VolumeGrid
from g3r.geometry.quaternion import rotation_from_quaternion

WIDEST = 3.0
"""Largest sigma of a new Gaussian, over that of the filter that found it."""

FIRST_SHARE = 0.7
"""Share of an extremum's height that a new Gaussian starts with: neighbours that are added with it overlap."""

NEIGHBOURHOOD = 8
"""Cells of the finest lattice over which the density of Gaussians is counted."""


@dataclass(frozen=True, kw_only=True)
class ResidualExtrema:
    """Extrema of a residual, each described as a Gaussian.

    Attributes:
        index: [M, 3] voxels.
        axes: [M, 3, 3] principal axes in world space (columns, right-handed).
        sigma_mm: [M, 3] along them.
        amplitude: [M].
        gain: [M] about how much each lowers the squared residual (times mm^3).
    """

    index: NDArray[np.int64]
    axes: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    gain: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.index)

    def take(self, chosen: NDArray[np.integer] | NDArray[np.bool_]) -> ResidualExtrema:
        """The extrema at an index array or a mask."""
        return ResidualExtrema(**{name: getattr(self, name)[chosen] for name in self.__dataclass_fields__})

    def cloud(self, grid: VolumeGrid, origin_mm: NDArray[np.float64]) -> GaussianCloud:
        """Gaussians of these shapes, at part of their height (`FIRST_SHARE`)."""
        xyzw = Rotation.from_matrix(self.axes).as_quat() if len(self) else np.zeros((0, 4))
        arrays = (
            grid.world(self.index) - origin_mm,
            np.log(self.sigma_mm),
            xyzw[:, [3, 0, 1, 2]],
            FIRST_SHARE * self.amplitude,
        )
        tensors = [torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32)) for a in arrays]
        return GaussianCloud.of(tensors, origin_mm)


def find_extrema(
    residual: NDArray[np.float32], mask: NDArray[np.bool_], grid: VolumeGrid, filter_mm: float, min_mm: float
) -> ResidualExtrema:
    """The local extrema of a smoothed residual inside a mask, with the shapes that the residual has there.

    Where a Gaussian of covariance C is smoothed with variance s^2, the logarithm of the result has the Hessian
    -(C + s^2)^-1 at its top. So the second derivatives of the smoothed residual, over its value,
    give C: flat along sheets, long along ridges, whatever their direction.

    Args:
        residual: [I, J, K], zero outside the mask.
        mask: [I, J, K].
        grid: their grid (voxels about as long as wide).
        filter_mm: sigma of the filter.
        min_mm: smallest sigma of an extremum; the largest is `WIDEST` filters.
    """
    voxel = float(grid.spacing_mm.mean())
    sigma = filter_mm / voxel
    smooth = gaussian_filter(residual, sigma)
    height = np.abs(smooth)
    top = (height == maximum_filter(height, size=3)) & mask & (height > 0)
    value = smooth[top].astype(np.float64)
    precision = np.empty((len(value), 3, 3))
    for a in range(3):
        for b in range(a, 3):
            order = np.bincount([a, b], minlength=3)
            second = gaussian_filter(residual, sigma, order=order.tolist())[top]
            precision[:, a, b] = precision[:, b, a] = -second / value
    eigenvalue, vectors = np.linalg.eigh(precision)
    index = np.argwhere(top)
    # C + s^2 along each axis; a direction in which the residual does not fall gets the widest
    total = 1 / np.maximum(eigenvalue, 1 / (sigma**2 * (1 + WIDEST**2)))
    variance = np.clip(total - sigma**2, (min_mm / voxel) ** 2, (WIDEST * sigma) ** 2)
    amplitude = value * np.sqrt(((variance + sigma**2) / variance).prod(1))
    axes = (grid.affine[:3, :3] / grid.spacing_mm) @ vectors
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    sigma_mm = np.sqrt(variance) * voxel
    gain = amplitude**2 * np.pi**1.5 * sigma_mm.prod(1)
    return ResidualExtrema(index=index, axes=axes, sigma_mm=sigma_mm, amplitude=amplitude, gain=gain)


def local_rms(
    residual: NDArray[np.float32], mask: NDArray[np.bool_], grid: VolumeGrid, window_mm: float
) -> NDArray[np.float32]:
    """Root mean square of a residual [I, J, K] around each voxel of a mask; 0 outside.

    Args:
        residual: [I, J, K].
        mask: [I, J, K].
        grid: their grid.
        window_mm: sigma of the Gaussian window.
    """
    sigma = window_mm / float(grid.spacing_mm.mean())
    inside = mask.astype(np.float32)
    weight = np.maximum(gaussian_filter(inside, sigma), 1e-6)
    mean_square = gaussian_filter(inside * residual**2, sigma) / weight
    return np.sqrt(np.maximum(mean_square, 0)) * mask


def exceeds_density(
    cloud: GaussianCloud, points_mm: NDArray[np.float64], finest_spacing_mm: float
) -> NDArray[np.bool_]:
    """Whether Gaussians are as close around points as on a lattice of the finest spacing.

    Args:
        cloud: the Gaussians.
        points_mm: [M, 3] in world space.
        finest_spacing_mm: edge of the cell per Gaussian.
    """
    if not len(points_mm):
        return np.zeros(0, bool)
    radius = finest_spacing_mm * (NEIGHBOURHOOD * 3 / (4 * np.pi)) ** (1 / 3)
    tree = cKDTree(cloud.mean_mm.detach().double().numpy() + cloud.origin_mm)
    count = tree.query_ball_point(points_mm, radius, return_length=True)
    return np.asarray(count >= NEIGHBOURHOOD)


def concatenated(first: GaussianCloud, second: GaussianCloud) -> GaussianCloud:
    """The Gaussians of two clouds of one origin."""
    pairs = zip(first.parameters, second.parameters, strict=True)
    return GaussianCloud.of([torch.cat([a.detach(), b.detach()]) for a, b in pairs], first.origin_mm)


def pruned(cloud: GaussianCloud, tolerance: float) -> GaussianCloud:
    """The cloud without the Gaussians whose integral of the square is below a tolerance (mm^3).

    Pruning one changes the volume by that integral, and by less once its neighbours' amplitudes are solved for.
    """
    return cloud.take(torch.from_numpy(_energy(cloud) >= tolerance))


def with_duplicates_merged(cloud: GaussianCloud, tolerance: float) -> GaussianCloud:
    """The cloud with pairs replaced by one Gaussian where that changes it by less than a tolerance (mm^3).

    Pairs are nearest neighbours of each other with amplitudes of one sign. The one has their common mass, mean and
    covariance; the change is the integral of the squared difference, in closed form from the products of
    Gaussians.
    """
    if len(cloud) < 2:
        return cloud
    mean = cloud.mean_mm.detach().double().numpy()
    amplitude = cloud.amplitude.detach().double().numpy()
    nearest = cKDTree(mean).query(mean, k=2)[1][:, 1]
    own = np.arange(len(cloud))
    first = np.flatnonzero((nearest[nearest] == own) & (own < nearest) & (amplitude * amplitude[nearest] > 0))
    second = nearest[first]
    if not len(first):
        return cloud
    covariance = _covariance(cloud)
    mass = amplitude * np.sqrt(np.linalg.det(covariance))
    share = (mass[first] / (mass[first] + mass[second]))[:, None]
    middle = share * mean[first] + (1 - share) * mean[second]
    spread = np.zeros((len(first), 3, 3))
    for part, weight in ((first, share), (second, 1 - share)):
        away = mean[part] - middle
        spread += weight[:, :, None] * (covariance[part] + away[:, :, None] * away[:, None, :])
    height = (mass[first] + mass[second]) / np.sqrt(np.linalg.det(spread))
    a = (amplitude[first], mean[first], covariance[first])
    b = (amplitude[second], mean[second], covariance[second])
    c = (-height, middle, spread)
    change = np.sum([_product(x, y) for x in (a, b, c) for y in (a, b, c)], axis=0)
    ok = np.asarray(change < tolerance)
    if not ok.any():
        return cloud
    keep = np.ones(len(cloud), bool)
    keep[first[ok]] = keep[second[ok]] = False
    variance, axes = np.linalg.eigh(spread[ok])
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    quaternion = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    arrays = (middle[ok], 0.5 * np.log(variance), quaternion, height[ok])
    merged = [torch.from_numpy(np.ascontiguousarray(x, dtype=np.float32)) for x in arrays]
    return concatenated(cloud.take(torch.from_numpy(keep)), GaussianCloud.of(merged, cloud.origin_mm))


Term = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _product(first: Term, second: Term) -> NDArray[np.float64]:
    """Integral of the product of Gaussians (amplitude [M], mean [M, 3], covariance [M, 3, 3]), in mm^3."""
    total = first[2] + second[2]
    away = first[1] - second[1]
    exponent = -0.5 * np.einsum("mi,mi->m", away, np.linalg.solve(total, away[:, :, None])[:, :, 0])
    determinants = np.linalg.det(first[2]) * np.linalg.det(second[2]) / np.linalg.det(total)
    return np.asarray(first[0] * second[0] * (2 * np.pi) ** 1.5 * np.sqrt(determinants) * np.exp(exponent))


def _covariance(cloud: GaussianCloud) -> NDArray[np.float64]:
    rotation = rotation_from_quaternion(cloud.quaternion_wxyz.detach().double()).numpy()
    variance = np.exp(2 * cloud.log_scale.detach().double().numpy())
    return np.asarray(np.einsum("nik,nk,njk->nij", rotation, variance, rotation))


def _energy(cloud: GaussianCloud) -> NDArray[np.float64]:
    """Integral of the square of each Gaussian [N], in mm^3."""
    log_volume = cloud.log_scale.detach().double().sum(1).numpy()
    return np.asarray(cloud.amplitude.detach().double().numpy() ** 2 * np.pi**1.5 * np.exp(log_volume))
