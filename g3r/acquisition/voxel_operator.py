"""The voxel forward operator, a slice pixel as a PSF-weighted mean of a volume (G3R Eq. 2), and its exact adjoint.

Both directions use the same trilinear weights (`acquisition.kernels`): one gathers, the other scatters, so that
<A x, y> = <x, A^T y> holds to rounding.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.kernels import gather, scatter
from g3r.acquisition.kernels_voxels import join
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
        """Take the poses of these planes, which are the same pixel grids at other poses."""
        inverse = self.grid.index_from_world
        self.index_from_plane = np.ascontiguousarray(inverse[:3, :3] @ planes.rotation)  # [K, 3, 3]
        self.index_center = planes.center_mm @ inverse[:3, :3].T + inverse[:3, 3]
        self.node_index = np.einsum("kij,kqj->kqi", self.index_from_plane, self.node_mm)
        self._geometries: dict[np.dtype[Any], tuple[NDArray[Any], ...]] = {}

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
        padded = np.zeros([n + 2 for n in volume.shape], volume.dtype)
        padded[1:-1, 1:-1, 1:-1] = volume
        pixels = np.zeros(self.n_pixels, volume.dtype)
        gather(padded.ravel(), *self._geometry(volume.dtype), pixels)  # type: ignore[call-arg]
        return pixels

    def adjoint(self, pixels: NDArray[np.floating]) -> NDArray[np.floating]:
        """A^T: adds pixel values [P'] to a volume [I, J, K] with the weights of `forward`.

        Raises:
            ValueError: another number of pixels.
        """
        if pixels.shape != (self.n_pixels,):
            raise ValueError(f"pixels have shape {pixels.shape}; expected ({self.n_pixels},)")
        n_buffers = min(numba.get_num_threads(), MAX_SCATTER_BUFFERS)
        padded = [n + 2 for n in self.grid.shape]
        buffers = np.zeros((n_buffers, math.prod(padded)), pixels.dtype)
        scatter(pixels, *self._geometry(pixels.dtype), buffers)  # type: ignore[call-arg]
        volume = np.empty(self.grid.shape, pixels.dtype)
        join(buffers.reshape(n_buffers, *padded), volume)
        return volume

    def _geometry(self, dtype: np.dtype[Any]) -> tuple[NDArray[Any], ...]:
        """Shape of a volume with a margin of one voxel, planes of the pixels, and where they and their nodes lie."""
        if dtype not in self._geometries:
            shape = np.array(self.grid.shape) + 2
            origin = self.index_center[:, None] + self.node_index + 1
            reals = [self.uv_mm.T, self.index_from_plane, origin, self.node_weight]
            uv, matrix, origin, weight = (np.ascontiguousarray(one, dtype) for one in reals)
            self._geometries[dtype] = shape.astype(dtype), self.plane, uv, matrix, origin, weight
        return self._geometries[dtype]
