"""Groups of kernel arguments: numba takes a named tuple of arrays as it takes single arrays.

What a parallel kernel writes is an argument of its own: numba does not see that an array from a tuple is the caller's,
and drops a loop that writes nothing else. Scratch space may be grouped, since what is written there is read again.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.kernels import PROJECTION, SHAPE_COLUMNS, derive_shapes
from g3r.gaussians.simd import N_LANES


class CloudArrays(NamedTuple):
    """N Gaussians.

    Attributes:
        shapes: [N, 10] float64, what `derive_shapes` writes.
        amplitude: [N] float32.
    """

    shapes: NDArray[np.float64]
    amplitude: NDArray[np.float32]

    @classmethod
    def of(cls, cloud: GaussianCloud) -> CloudArrays:
        """The arrays of a cloud on the CPU."""
        mean, log_scale, quaternion, amplitude = (np.ascontiguousarray(p.detach().numpy()) for p in cloud.parameters)
        shapes = np.empty((len(mean), SHAPE_COLUMNS))
        derive_shapes(mean, log_scale, quaternion, shapes)
        return cls(shapes, amplitude.astype(np.float32))


class PlaneArrays(NamedTuple):
    """K planes at their present poses.

    Attributes:
        rotation: [K, 3, 3].
        center: [K, 3] mm from the cloud's origin.
        gain: [K] intensity factor.
        psf: [K, 3] variances, mm^2.
        shape: [K, 2] pixels.
        spacing: [K, 2] mm.
        offset: [K] or more, number of each plane's first pixel.
    """

    rotation: NDArray[np.float64]
    center: NDArray[np.float64]
    gain: NDArray[np.float64]
    psf: NDArray[np.float64]
    shape: NDArray[np.int64]
    spacing: NDArray[np.float64]
    offset: NDArray[np.int64]

    @classmethod
    def of(
        cls, planes: Planes, origin_mm: NDArray[np.float64], gain: NDArray[np.floating] | None = None
    ) -> PlaneArrays:
        """The arrays of planes.

        Args:
            planes: K planes.
            origin_mm: [3] of the cloud.
            gain: [K] intensity factors; 1 when None.
        """
        factor = np.asarray(np.ones(len(planes)) if gain is None else gain, dtype=np.float64)
        center = planes.center_mm - origin_mm
        return cls(planes.rotation, center, factor, planes.psf_var_mm2, planes.shape, planes.spacing_mm, planes.offset)


class OverlapArrays(NamedTuple):
    """Gaussians that may touch plane k: `order[start[k] : start[k + 1]]`."""

    start: NDArray[np.int64]
    order: NDArray[np.int32]


class Workspace(NamedTuple):
    """Scratch space, a row for each worker.

    Attributes:
        images: [n_workers, padded pixels] image of the plane that a worker is at.
        projections: [n_workers, pairs] projections onto that plane.
    """

    images: NDArray[np.float32]
    projections: NDArray[np.void]

    @classmethod
    def of(cls, planes: Planes, max_pairs: int) -> Workspace:
        """Room for the largest plane and the longest overlap list of one plane."""
        n_workers = numba.get_num_threads()
        padded = planes.shape[:, 0] * (planes.shape[:, 1] + N_LANES) + N_LANES
        return cls(
            np.zeros((n_workers, int(padded.max(initial=1))), np.float32), np.zeros((n_workers, max_pairs), PROJECTION)
        )
