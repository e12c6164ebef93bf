"""Which Gaussians may touch which planes: a list that stays valid while nothing moves far."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.gaussians.arrays import CloudArrays, OverlapArrays
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.kernels_overlap import PlaneExtents, columns_of, find


@dataclass(frozen=True)
class OverlapList:
    """Gaussians of plane k: `gaussian[start[k] : start[k + 1]]`, ascending."""

    start: NDArray[np.int64]
    gaussian: NDArray[np.int32]

    def __len__(self) -> int:
        return int(self.start[-1])

    @property
    def most(self) -> int:
        """Largest number of Gaussians of one plane."""
        return int(np.diff(self.start).max(initial=0))

    @property
    def arrays(self) -> OverlapArrays:
        """The arrays for the kernels."""
        return OverlapArrays(self.start, self.gaussian)


def find_overlaps(cloud: GaussianCloud, planes: Planes, cutoff_sigma: float) -> OverlapList:
    """The Gaussians whose ellipsoid at the cut-off may meet each plane's rectangle.

    Pass a larger cut-off than the renderer's to keep the list valid while Gaussians and poses move a little:
    a Gaussian that does not touch the plane costs a projection and no pixels.

    Args:
        cloud: N Gaussians.
        planes: K planes.
        cutoff_sigma: where a Gaussian ends.
    """
    shapes = CloudArrays.of(cloud).shapes
    finder = OverlapFinder(len(cloud))
    return finder.find(shapes, planes, planes.rotation, planes.center_mm - cloud.origin_mm, cutoff_sigma)


class OverlapFinder:
    """Makes overlap lists repeatedly, in memory taken once."""

    def __init__(self, n_gaussians: int) -> None:
        self.columns = np.empty((9, n_gaussians), np.float32)
        self.marks = np.zeros((numba.get_num_threads(), n_gaussians), np.uint8)
        self.order = np.empty(0, np.int32)

    def find(
        self,
        shapes: NDArray[np.float64],
        planes: Planes,
        rotation: NDArray[np.float64],
        center_mm: NDArray[np.float64],
        cutoff_sigma: float,
    ) -> OverlapList:
        """The overlap list of Gaussians and planes; it is valid until the next call.

        Args:
            shapes: [N, 10] of `derive_shapes`.
            planes: K planes; their sizes and PSFs are read.
            rotation: [K, 3, 3] of the planes at the moment.
            center_mm: [K, 3] of the planes at the moment, mm from the cloud's origin.
            cutoff_sigma: where a Gaussian ends.
        """
        half = np.zeros((len(planes), 3), np.float32)
        half[:, :2] = (planes.shape - 1) / 2 * planes.spacing_mm
        # relative to the middle of the planes, float32 is enough, wherever the cloud's origin is
        middle = center_mm.mean(0) if len(center_mm) else np.zeros(3)
        single = [array.astype(np.float32) for array in (rotation, center_mm - middle, planes.psf_var_mm2)]
        extents = PlaneExtents(single[0], single[1], single[2], half)
        start = np.zeros(len(planes) + 1, np.int64)
        cut = np.float32(cutoff_sigma**2 * (1 + 1e-5))
        columns_of(shapes, middle, self.columns)
        find(self.columns, extents, cut, self.marks, start, self.order[:0])
        n_pairs = int(start[-1])
        if n_pairs > len(self.order):
            self.order = np.empty(n_pairs + n_pairs // 8, np.int32)
        if n_pairs:
            find(self.columns, extents, cut, self.marks, start, self.order[:n_pairs])
        return OverlapList(start, self.order[:n_pairs])
