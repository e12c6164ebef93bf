"""Voxel grids (a shape and an affine, RAS+ mm from index), bounding boxes, and maps resampled on another grid."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import affine_transform

from g3r.geometry.rigid import RigidPose

SLAB = 32
"""Planes of a map that are read at once. It does not depend on the number of threads, so neither does rounding."""


@dataclass(frozen=True)
class VolumeGrid:
    """A grid of voxels; an integer index is the centre of a voxel.

    Args:
        shape: number of voxels (I, J, K).
        affine: [4, 4], world (RAS+, mm) from index.

    Raises:
        ValueError: an empty axis, or an affine that is not finite or not invertible.
    """

    shape: tuple[int, int, int]
    affine: NDArray[np.float64]

    def __post_init__(self) -> None:
        shape = tuple(int(n) for n in self.shape)
        affine = np.array(self.affine, dtype=np.float64)
        if len(shape) != 3 or min(shape) < 1:
            raise ValueError(f"grid shape {shape}; expected three positive numbers")
        if affine.shape != (4, 4) or not np.isfinite(affine).all():
            raise ValueError("grid affine must be a finite 4x4 matrix")
        spacing = np.linalg.norm(affine[:3, :3], axis=0)
        # relative to the voxel's own size, so that the limit has no unit
        if spacing.min() == 0 or abs(np.linalg.det(affine[:3, :3] / spacing)) < 1e-6:
            raise ValueError("grid affine is singular")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "affine", affine)

    @classmethod
    def isotropic(cls, low_mm: ArrayLike, high_mm: ArrayLike, spacing_mm: float, margin_mm: float = 0.0) -> VolumeGrid:
        """The axis-aligned RAS grid with cubic voxels that covers a box and a margin around it.

        Args:
            low_mm: [3] lowest corner of the box.
            high_mm: [3] highest corner.
            spacing_mm: edge of the voxels.
            margin_mm: added on every side.
        """
        low = np.asarray(low_mm, dtype=np.float64) - margin_mm
        high = np.asarray(high_mm, dtype=np.float64) + margin_mm
        shape = np.maximum(np.ceil((high - low) / spacing_mm).astype(int) + 1, 1)
        affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
        affine[:3, 3] = (low + high) / 2 - (shape - 1) / 2 * spacing_mm
        return cls((int(shape[0]), int(shape[1]), int(shape[2])), affine)

    @classmethod
    def centred(cls, shape: Sequence[int], spacing_mm: float) -> VolumeGrid:
        """The axis-aligned RAS grid with cubic voxels whose middle is the origin.

        Args:
            shape: [3] voxels along the axes.
            spacing_mm: edge of the voxels.
        """
        affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
        affine[:3, 3] = -(np.array(shape) - 1) / 2 * spacing_mm
        return cls((shape[0], shape[1], shape[2]), affine)

    def respaced(self, spacing_mm: float) -> VolumeGrid:
        """The axis-aligned grid of cubic voxels of another size over the same box; this grid if it has that size."""
        if np.isclose(self.spacing_mm[0], spacing_mm, rtol=1e-6):
            return self
        return VolumeGrid.isotropic(self.world([0, 0, 0]), self.world(np.array(self.shape) - 1), spacing_mm)

    def moved(self, pose: RigidPose) -> VolumeGrid:
        """The same voxels after a rigid motion of the world (one pose)."""
        return VolumeGrid(self.shape, pose.matrix[0] @ self.affine)

    def scaled_about(self, center_mm: NDArray[np.float64], scale: float) -> VolumeGrid:
        """The same voxels enlarged by a factor about a point [3] that stays in place."""
        affine = self.affine.copy()
        affine[:3, :3] *= scale
        affine[:3, 3] = center_mm + scale * (self.affine[:3, 3] - center_mm)
        return VolumeGrid(self.shape, affine)

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """Distance between neighbouring voxels along each axis [3]."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0), dtype=np.float64)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors along the axes in the world, as columns [3, 3]."""
        return self.affine[:3, :3] / self.spacing_mm

    @property
    def shear(self) -> float:
        """Largest cosine between two axes; 0 if they are orthogonal."""
        axes = self.axes
        return float(np.abs(axes.T @ axes - np.eye(3)).max())

    @property
    def plane_frame(self) -> NDArray[np.float64]:
        """First axis, second axis and their normal as columns [3, 3]; right-handed, whatever the third axis is."""
        axes = self.axes
        return np.stack([axes[:, 0], axes[:, 1], np.cross(axes[:, 0], axes[:, 1])], axis=1)

    @property
    def voxel_volume_mm3(self) -> float:
        """Volume of a voxel."""
        return float(abs(np.linalg.det(self.affine[:3, :3])))

    def volume_ml(self, mask: NDArray[np.bool_]) -> float:
        """Volume of a mask [I, J, K] on the grid."""
        return np.count_nonzero(mask) * self.voxel_volume_mm3 / 1000

    @property
    def center_mm(self) -> NDArray[np.float64]:
        """World position of the middle of the grid [3]."""
        return self.world((np.array(self.shape) - 1) / 2)

    @property
    def corner_index(self) -> NDArray[np.int64]:
        """Indices of the eight corner voxels [8, 3]."""
        return np.array(np.meshgrid(*[(0, n - 1) for n in self.shape], indexing="ij")).reshape(3, -1).T

    @property
    def index_from_world(self) -> NDArray[np.float64]:
        """The affine [4, 4] from world to (fractional) index."""
        return np.asarray(np.linalg.inv(self.affine), dtype=np.float64)

    def world(self, index: ArrayLike) -> NDArray[np.float64]:
        """World positions (mm) of indices [..., 3]."""
        return np.asarray(index, dtype=np.float64) @ self.affine[:3, :3].T + self.affine[:3, 3]

    def index(self, world_mm: ArrayLike) -> NDArray[np.float64]:
        """Fractional indices of world positions [..., 3]."""
        inverse = self.index_from_world
        return np.asarray(world_mm, dtype=np.float64) @ inverse[:3, :3].T + inverse[:3, 3]

    def cropped(self, box: tuple[slice, ...]) -> VolumeGrid:
        """The grid of `array[box]`, for a box as `bounding_box` returns it."""
        affine = self.affine.copy()
        affine[:3, 3] = self.world([axis.start for axis in box])
        return VolumeGrid((box[0].stop - box[0].start, box[1].stop - box[1].start, box[2].stop - box[2].start), affine)


def bounding_box(mask: NDArray[np.bool_], margin: ArrayLike = 0) -> tuple[slice, ...]:
    """The smallest box that holds all of a mask, enlarged by a margin as far as the array reaches.

    Args:
        mask: boolean array of any dimension.
        margin: voxels on every side, one number or one for each axis.

    Raises:
        ValueError: an empty mask.
    """
    if not mask.any():
        raise ValueError("the mask is empty")
    axes = range(mask.ndim)
    inside = [np.flatnonzero(mask.any(tuple(other for other in axes if other != axis))) for axis in axes]
    low = np.maximum([index[0] for index in inside] - np.asarray(margin), 0)
    high = np.minimum([index[-1] + 1 for index in inside] + np.asarray(margin), mask.shape)
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def on_grid(data: NDArray[np.floating], source: VolumeGrid, target: VolumeGrid, outside: float) -> NDArray[np.float32]:
    """A map resampled on another grid by trilinear interpolation.

    Args:
        data: [I, J, K] on `source`.
        source: its grid.
        target: the grid of the result.
        outside: value where `source` does not reach.
    """
    if source.shape == target.shape and np.allclose(source.affine, target.affine, atol=1e-9):
        return data.astype(np.float32)
    index, data = source.index_from_world @ target.affine, data.astype(np.float32)
    found = np.empty(target.shape, np.float32)

    def fill(first: int) -> None:
        shift, part = index[:3, 3] + index[:3, 0] * first, found[first : first + SLAB]
        affine_transform(data, index[:3, :3], shift, part.shape, part, order=1, mode="constant", cval=outside)

    with ThreadPoolExecutor(numba.get_num_threads()) as pool:  # scipy uses one thread and releases the GIL
        list(pool.map(fill, range(0, len(found), SLAB)))
    return found
