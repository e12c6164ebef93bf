"""Which Gaussians may touch which planes: a list that stays valid while nothing moves far."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.gaussians import kernels
from g3r.gaussians import kernels_overlap as kernels_pairs
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.simd import N_LANES


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


def find_overlaps(cloud: GaussianCloud, planes: Planes, cutoff_sigma: float) -> OverlapList:
    """All pairs whose ellipsoid at the cut-off may meet the plane's rectangle.

    Pass a larger cut-off than the renderer's to keep the list valid while Gaussians and poses move a little:
    pairs that no longer touch cost a set-up and no pixels.
    """
    shapes = CloudArrays.of(cloud).shapes
    finder = OverlapFinder(len(cloud))
    return finder.find(shapes, planes, planes.rotation, planes.center_mm - cloud.origin_mm, cutoff_sigma)


class OverlapFinder:
    """Finds pairs again and again, in memory taken once."""

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
        """The pairs of derived shapes [N, 10] with planes; the list is valid until the next call.

        Args:
            shapes: of the Gaussians.
            planes: for their sizes and PSFs.
            rotation: [K, 3, 3] of the planes at present.
            center_mm: [K, 3] of the planes at present, from the cloud's origin.
            cutoff_sigma: where a Gaussian ends.
        """
        half = np.zeros((len(planes), 3), np.float32)
        half[:, :2] = (planes.shape - 1) / 2 * planes.spacing_mm
        # float32 is enough from the middle of the planes, wherever the cloud's origin is
        middle = center_mm.mean(0) if len(center_mm) else np.zeros(3)
        single = [array.astype(np.float32) for array in (rotation, center_mm - middle, planes.psf_var_mm2)]
        start = np.zeros(len(planes) + 1, np.int64)
        cut = np.float32(cutoff_sigma**2 * (1 + 1e-5))
        kernels_pairs.columns_of(shapes, middle, self.columns)
        arguments = (self.columns, *single, half, cut, self.marks, start)
        kernels_pairs.find(*arguments, self.order[:0])  # type: ignore[call-arg]
        n_pairs = int(start[-1])
        if n_pairs > len(self.order):
            self.order = np.empty(n_pairs + n_pairs // 8, np.int32)
        if n_pairs:
            kernels_pairs.find(*arguments, self.order[:n_pairs])  # type: ignore[call-arg]
        return OverlapList(start, self.order[:n_pairs])


@dataclass(frozen=True)
class CloudArrays:
    """What the kernels read of a cloud: derived shapes [N, 10] float64, amplitudes, and what they come from."""

    shapes: NDArray[np.float64]
    amplitude: NDArray[np.float32]
    log_scale: NDArray[np.floating]
    quaternion: NDArray[np.floating]

    @classmethod
    def of(cls, cloud: GaussianCloud) -> CloudArrays:
        """Views and derived arrays of a cloud on the CPU."""
        mean, log_scale, quaternion, amplitude = (np.ascontiguousarray(p.detach().numpy()) for p in cloud.parameters)
        shapes = np.empty((len(mean), kernels.SHAPE_COLUMNS))
        kernels.derive_shapes(mean, log_scale, quaternion, shapes)
        return cls(shapes, amplitude.astype(np.float32), log_scale, quaternion)


@dataclass(frozen=True)
class Workspace:
    """Scratch space of the kernels, a row for each worker: a padded image, and the records of a plane."""

    images: NDArray[np.float32]
    projections: NDArray[np.void]

    @classmethod
    def of(cls, planes: Planes, max_pairs: int) -> Workspace:
        """Room for the largest plane and the longest list of pairs of one plane."""
        n_workers = numba.get_num_threads()
        padded = planes.shape[:, 0] * (planes.shape[:, 1] + N_LANES) + N_LANES
        return cls(
            np.zeros((n_workers, int(padded.max(initial=1))), np.float32),
            np.zeros((n_workers, max_pairs), kernels.PAIR),
        )
