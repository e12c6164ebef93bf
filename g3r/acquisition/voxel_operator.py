"""The voxel forward operator, a slice pixel as a PSF-weighted mean of a volume (G3R Eq. 2), and its exact adjoint.

Both directions run the same loop over the same trilinear weights, one gathers and one scatters, so that
<A x, y> = <x, A^T y> holds to rounding.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.geometry import VolumeGrid

MAX_SCATTER_BUFFERS = 4
"""Each scattering thread needs its own volume; more than four cost more memory than they save time."""


def psf_nodes(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Equidistant nodes (in sigmas) and weights for a Gaussian of unit variance.

    Weights add to one; nodes are scaled so that the discrete variance is exactly one. The equidistant rule
    converges exponentially for a Gaussian and, unlike Gauss-Hermite nodes, leaves no holes when scattering.
    """
    if n == 1:
        return np.zeros(1), np.ones(1)
    nodes = np.linspace(-1.0, 1.0, n) * min((n - 1) / 2, 2.6)
    weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    return nodes / math.sqrt(float((weights * nodes**2).sum())), weights


class VoxelOperator:
    """A: volume on a grid -> pixels of planes.

    Args:
        planes: K planes.
        grid: voxel grid of the volume; outside it the volume is zero.
        pixel_index: [P'] numbers of the pixels to compute; all when None.
        psf_points: number of quadrature nodes along the planes' x, y and normal.
    """

    def __init__(
        self,
        planes: Planes,
        grid: VolumeGrid,
        pixel_index: NDArray[np.int64] | None = None,
        psf_points: tuple[int, int, int] = (1, 1, 5),
    ) -> None:
        self.grid = grid
        plane = planes.plane_id()
        self.plane = plane if pixel_index is None else plane[pixel_index]
        self.uv_mm = planes.pixel_uv_mm(pixel_index)
        axis = [psf_nodes(n) for n in psf_points]
        nodes = np.stack(np.meshgrid(*[a[0] for a in axis], indexing="ij"), -1).reshape(-1, 3)
        self.node_weight = np.einsum("i,j,k->ijk", *[a[1] for a in axis]).ravel()
        self.node_mm = nodes[None] * np.sqrt(planes.psf_var_mm2)[:, None]  # [K, Q, 3] in the plane's frame
        self.move(planes)

    def move(self, planes: Planes) -> None:
        """Take the poses of these planes, the same pixel grids elsewhere."""
        inverse = self.grid.index_from_world
        self.index_from_plane = np.ascontiguousarray(inverse[:3, :3] @ planes.rotation)  # [K, 3, 3]
        self.index_center = planes.center_mm @ inverse[:3, :3].T + inverse[:3, 3]
        self.node_index = np.einsum("kij,kqj->kqi", self.index_from_plane, self.node_mm)

    @property
    def n_pixels(self) -> int:
        """Number of pixels P'."""
        return len(self.plane)

    def forward(self, volume: NDArray[np.floating]) -> NDArray[np.floating]:
        """Pixels [P'] of a volume [I, J, K], in the dtype of the volume (G3R Eq. 2 on voxels).

        Raises:
            ValueError: the volume is not on the operator's grid.
        """
        if volume.shape != self.grid.shape:
            raise ValueError(f"volume has shape {volume.shape}; the operator's grid is {self.grid.shape}")
        pixels = np.zeros(self.n_pixels, volume.dtype)
        _gather(
            np.ascontiguousarray(volume),
            self.plane,
            self.uv_mm,
            self.index_from_plane,
            self.index_center,
            self.node_index,
            self.node_weight,
            pixels,
        )
        return pixels

    def adjoint(self, pixels: NDArray[np.floating]) -> NDArray[np.floating]:
        """A^T: adds pixel values [P'] to a volume [I, J, K] with the weights of `forward`.

        Raises:
            ValueError: another number of pixels.
        """
        if pixels.shape != (self.n_pixels,):
            raise ValueError(f"pixels have shape {pixels.shape}; expected ({self.n_pixels},)")
        n_buffers = min(numba.get_num_threads(), MAX_SCATTER_BUFFERS)
        buffers = np.zeros((n_buffers, *self.grid.shape), pixels.dtype)
        _scatter(
            pixels,
            self.plane,
            self.uv_mm,
            self.index_from_plane,
            self.index_center,
            self.node_index,
            self.node_weight,
            buffers,
        )
        return buffers[0] if n_buffers == 1 else buffers.sum(0)


@numba.njit(inline="always")
def _pixel_index(p, plane, uv, index_from_plane, index_center):
    k = plane[p]
    u, v = uv[p, 0], uv[p, 1]
    m = index_from_plane[k]
    x = index_center[k, 0] + m[0, 0] * u + m[0, 1] * v
    y = index_center[k, 1] + m[1, 0] * u + m[1, 1] * v
    z = index_center[k, 2] + m[2, 0] * u + m[2, 1] * v
    return k, x, y, z


@numba.njit(parallel=True, cache=True)
def _gather(volume, plane, uv, index_from_plane, index_center, node_index, node_weight, pixels):
    n_i, n_j, n_k = volume.shape
    for p in numba.prange(len(plane)):
        k, x0, y0, z0 = _pixel_index(p, plane, uv, index_from_plane, index_center)
        total = 0.0
        for q in range(len(node_weight)):
            x, y, z = x0 + node_index[k, q, 0], y0 + node_index[k, q, 1], z0 + node_index[k, q, 2]
            i, j, h = math.floor(x), math.floor(y), math.floor(z)
            if i < -1 or j < -1 or h < -1 or i >= n_i or j >= n_j or h >= n_k:
                continue
            fx, fy, fz = x - i, y - j, z - h
            if 0 <= i < n_i - 1 and 0 <= j < n_j - 1 and 0 <= h < n_k - 1:  # nearly all: no cell cut off
                v00 = volume[i, j, h] * (1.0 - fz) + volume[i, j, h + 1] * fz
                v01 = volume[i, j + 1, h] * (1.0 - fz) + volume[i, j + 1, h + 1] * fz
                v10 = volume[i + 1, j, h] * (1.0 - fz) + volume[i + 1, j, h + 1] * fz
                v11 = volume[i + 1, j + 1, h] * (1.0 - fz) + volume[i + 1, j + 1, h + 1] * fz
                v0, v1 = v00 * (1.0 - fy) + v01 * fy, v10 * (1.0 - fy) + v11 * fy
                total += node_weight[q] * (v0 * (1.0 - fx) + v1 * fx)
                continue
            for a in range(2):
                if i + a < 0 or i + a >= n_i:
                    continue
                wx = fx if a else 1.0 - fx
                for b in range(2):
                    if j + b < 0 or j + b >= n_j:
                        continue
                    wxy = wx * (fy if b else 1.0 - fy) * node_weight[q]
                    if h >= 0:
                        total += wxy * (1.0 - fz) * volume[i + a, j + b, h]
                    if h + 1 < n_k:
                        total += wxy * fz * volume[i + a, j + b, h + 1]
        pixels[p] = total


@numba.njit(parallel=True, cache=True)
def _scatter(pixels, plane, uv, index_from_plane, index_center, node_index, node_weight, buffers):
    n_buffers, n_i, n_j, n_k = buffers.shape
    n = len(plane)
    for chunk in numba.prange(n_buffers):
        volume = buffers[chunk]
        for p in range(chunk * n // n_buffers, (chunk + 1) * n // n_buffers):
            k, x0, y0, z0 = _pixel_index(p, plane, uv, index_from_plane, index_center)
            value = pixels[p]
            for q in range(len(node_weight)):
                x, y, z = x0 + node_index[k, q, 0], y0 + node_index[k, q, 1], z0 + node_index[k, q, 2]
                i, j, h = math.floor(x), math.floor(y), math.floor(z)
                if i < -1 or j < -1 or h < -1 or i >= n_i or j >= n_j or h >= n_k:
                    continue
                fx, fy, fz = x - i, y - j, z - h
                if 0 <= i < n_i - 1 and 0 <= j < n_j - 1 and 0 <= h < n_k - 1:
                    w0, w1 = node_weight[q] * value * (1.0 - fx), node_weight[q] * value * fx
                    w00, w01, w10, w11 = w0 * (1.0 - fy), w0 * fy, w1 * (1.0 - fy), w1 * fy
                    volume[i, j, h] += w00 * (1.0 - fz)
                    volume[i, j, h + 1] += w00 * fz
                    volume[i, j + 1, h] += w01 * (1.0 - fz)
                    volume[i, j + 1, h + 1] += w01 * fz
                    volume[i + 1, j, h] += w10 * (1.0 - fz)
                    volume[i + 1, j, h + 1] += w10 * fz
                    volume[i + 1, j + 1, h] += w11 * (1.0 - fz)
                    volume[i + 1, j + 1, h + 1] += w11 * fz
                    continue
                for a in range(2):
                    if i + a < 0 or i + a >= n_i:
                        continue
                    wx = fx if a else 1.0 - fx
                    for b in range(2):
                        if j + b < 0 or j + b >= n_j:
                            continue
                        wxy = wx * (fy if b else 1.0 - fy) * node_weight[q] * value
                        if h >= 0:
                            volume[i + a, j + b, h] += wxy * (1.0 - fz)
                        if h + 1 < n_k:
                            volume[i + a, j + b, h + 1] += wxy * fz
