"""Seeds of the fit (G3R Sec. 2.4): Gaussians of Eq. 3 on a lattice in the foreground, thin across edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Slices
from g3r.gaussians.cloud import GaussianCloud
from g3r.geometry import VolumeGrid
from g3r.run.on_demand import torch

SCALE_PER_SPACING = 0.6
"""Sigma of a seed over the lattice spacing: neighbours overlap so that a constant is flat to 2 %."""

MAX_ANISOTROPY = 1.6
"""Largest ratio of a seed's sigma to that of a round one of equal volume."""


@dataclass(frozen=True, kw_only=True)
class LatticeSpacing:
    """Spacing of the lattice of Gaussians.

    Args:
        pixels: cell edge per Gaussian, in units of the cube root of what one pixel covers.
        at_most_mm: upper bound of that edge in mm, whatever the pixels: the cortex is as thick in thick slices.
    """

    pixels: float
    at_most_mm: float

    def mm(self, slices: Slices) -> float:
        """Cell edge per Gaussian for the median pixel of some slices."""
        return min(self.pixels * slices.typical_pixel_mm, self.at_most_mm)


def seed_cloud(
    volume: NDArray[np.float32],
    mask: NDArray[np.bool_],
    grid: VolumeGrid,
    spacing_mm: float,
    shift: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
) -> GaussianCloud:
    """Gaussians on a body-centred lattice inside the mask, shaped by the local structure of a volume.

    Each Gaussian is made thin across the edge at its centre (structure tensor) and keeps its volume. Amplitudes are
    first guesses that reproduce the local mean.

    Args:
        volume: [I, J, K], of order one.
        mask: [I, J, K], foreground.
        grid: their grid.
        spacing_mm: edge of the lattice cell per Gaussian (its volume to the power 1/3).
        shift: [3] of the lattice, in edges of its cubes, from 0 to 1.

    Returns:
        A cloud with its origin in the middle of the grid.

    Raises:
        ValueError: the mask is empty.
    """
    if not mask.any():
        raise ValueError("the foreground is empty")
    voxel = float(grid.spacing_mm.mean())
    gradient = np.stack([gaussian_filter(volume, 1.0, order=np.eye(3, dtype=int)[a]) / voxel for a in range(3)])
    strength = gaussian_filter(np.sqrt((gradient**2).sum(0)), spacing_mm / voxel)
    corners = grid.world(np.argwhere(mask))
    low, high = corners.min(0), corners.max(0)
    points = _inside(_lattice(low, high, spacing_mm, np.asarray(shift)), mask, grid)
    log_scale, quaternion = _shapes(gradient, grid, points, spacing_mm, strength)
    # a lattice of Gaussians of mean volume h^3 adds up to amplitude (2 pi)^1.5 s1 s2 s3 / h^3
    overlap = (2 * np.pi) ** 1.5 * np.exp(log_scale.sum(1)) / spacing_mm**3
    amplitude = _sample(volume, grid, points) / overlap
    origin = grid.center_mm

    def tensor(array: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))

    return GaussianCloud.of([tensor(points - origin), tensor(log_scale), tensor(quaternion), tensor(amplitude)], origin)


def _lattice(
    low: NDArray[np.float64], high: NDArray[np.float64], spacing_mm: float, shift: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Body-centred cubic points [N, 3], one per spacing^3."""
    edge = spacing_mm * 2 ** (1 / 3)
    axes = [np.arange(a, b + edge, edge) for a, b in zip(low - shift * edge, high, strict=True)]
    cube = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return np.concatenate([cube, cube + edge / 2])


def _inside(points: NDArray[np.float64], mask: NDArray[np.bool_], grid: VolumeGrid) -> NDArray[np.float64]:
    index = np.rint(grid.index(points)).astype(int)
    ok = np.asarray(((index >= 0) & (index < mask.shape)).all(1))
    ok[ok] = mask[tuple(index[ok].T)]
    return points[ok]


def _sample(volume: NDArray[np.floating], grid: VolumeGrid, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return map_coordinates(volume, grid.index(points).T, order=1, mode="nearest", output=np.float64)


def _shapes(
    gradient: NDArray[np.float32],
    grid: VolumeGrid,
    points: NDArray[np.float64],
    spacing_mm: float,
    strength: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log-scales [N, 3] and quaternions (w x y z) [N, 4] from the structure tensor at the points."""
    tensor = np.empty((len(points), 3, 3))
    sigma = float(spacing_mm / grid.spacing_mm.mean())
    for a in range(3):
        for b in range(a, 3):
            smooth = gaussian_filter(gradient[a] * gradient[b], sigma)
            tensor[:, a, b] = tensor[:, b, a] = _sample(smooth, grid, points)
    # gradients are along the grid's axes; a rotation takes them to world axes
    tensor = grid.axes @ tensor @ grid.axes.T
    energy, vectors = np.linalg.eigh(tensor)
    floor = 0.1 * float(np.mean(strength**2)) + 1e-12
    ratio = (energy + floor) ** -0.25
    ratio /= np.exp(np.log(ratio).mean(1, keepdims=True))
    ratio = np.clip(ratio, 1 / MAX_ANISOTROPY, MAX_ANISOTROPY)
    ratio /= np.exp(np.log(ratio).mean(1, keepdims=True))
    vectors[:, :, 2] *= np.sign(np.linalg.det(vectors))[:, None]
    xyzw = Rotation.from_matrix(vectors).as_quat()
    return np.log(SCALE_PER_SPACING * spacing_mm * ratio), xyzw[:, [3, 0, 1, 2]]
