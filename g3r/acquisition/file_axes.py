"""Conversion between the axes of a file and those of a stack, the same for every program that wrote the file.

One acquisition arrives through different converters. They store rows in either order, and their affines differ in the
last digits. Search and fit (L1, Adam) amplify the smallest difference until it is as large as their own tolerance,
some 0.5 % of the range. So pixels are put in one order, and geometry is rounded to steps too small to matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.geometry import RigidPose, VolumeGrid

Scalar = TypeVar("Scalar", bound=np.generic)

QUATERNION_STEP = 5e-5
"""Rounding step of the orientation's quaternion: at most 0.01 mm at 120 mm from the middle."""

CENTER_STEP_MM = 2.0**-7
"""Rounding step of the middle of the image. A power of two: a length with few decimals then never lies half-way between
two multiples, where its last digit would decide."""

SPACING_STEP_MM = (1e-6, 1e-6, 1e-4)
"""Rounding steps of the voxel size. Pixel sizes have few digits (1.171875 mm), as do the positions that slice distances
are computed from."""


@dataclass(frozen=True)
class FileAxes:
    """How a file's array becomes one with slices along the third axis and rows in the usual order.

    Attributes:
        slice_axis: axis of the file that becomes the third one. Slices keep their numbers.
        flipped: whether the first and the second axis run backwards.
    """

    slice_axis: int = 2
    flipped: tuple[bool, bool] = (False, False)

    @classmethod
    def of(cls, grid: VolumeGrid, slice_axis: int) -> FileAxes:
        """The axes of a file: both axes of a slice point right, to the front, or up, whichever is nearest.

        Args:
            grid: of the file.
            slice_axis: the file's axis across the slices, 0 to 2 (`find_slice_axis`).
        """
        axes = cls(slice_axis).grid_from_file(grid).affine[:3, :2]
        main = axes[np.abs(axes).argmax(0), [0, 1]]
        return cls(slice_axis, (bool(main[0] < 0), bool(main[1] < 0)))

    def from_file(self, array: NDArray[Scalar]) -> NDArray[Scalar]:
        """A file's array as [I, J, K], contiguous."""
        return np.ascontiguousarray(np.moveaxis(array, self.slice_axis, 2)[self._steps])

    def to_file(self, array: NDArray[Scalar]) -> NDArray[Scalar]:
        """An array [I, J, K] with the axes of the file."""
        return np.moveaxis(array[self._steps], 2, self.slice_axis)

    def grid_from_file(self, grid: VolumeGrid) -> VolumeGrid:
        """The grid of `from_file`'s result."""
        shape, affine = [grid.shape[axis] for axis in self._order], grid.affine.copy()
        affine[:3, :3] = affine[:3, self._order]
        return self._turned(VolumeGrid((shape[0], shape[1], shape[2]), affine))

    def grid_to_file(self, grid: VolumeGrid) -> VolumeGrid:
        """The grid of `to_file`'s result."""
        grid = self._turned(grid)
        shape, affine = np.empty(3, int), grid.affine.copy()
        shape[self._order] = grid.shape
        affine[:3, self._order] = grid.affine[:3, :3]
        return VolumeGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)

    @property
    def _order(self) -> list[int]:
        return [axis for axis in range(3) if axis != self.slice_axis] + [self.slice_axis]

    @property
    def _steps(self) -> tuple[slice, slice]:
        first, second = (slice(None, None, -1 if backwards else 1) for backwards in self.flipped)
        return first, second

    def _turned(self, grid: VolumeGrid) -> VolumeGrid:
        affine = grid.affine.copy()
        for axis in np.flatnonzero(self.flipped):
            affine[:3, 3] += (grid.shape[axis] - 1) * affine[:3, axis]
            affine[:3, axis] *= -1
        return VolumeGrid(grid.shape, affine)


AS_IN_FILE = FileAxes()
"""The axes of an array that is used as it lies in its file."""


def settled(grid: VolumeGrid) -> VolumeGrid:
    """The grid, rounded so that headers of one acquisition that differ in their last digits give the same grid.

    No point within 120 mm of the middle moves by more than 0.02 mm. Rarely two such headers round to different grids.

    Args:
        grid: slices along the third axis.
    """
    rotation, mirror = _nearest_rotation(grid)
    # q and -q are the same rotation and round to the same one
    quaternion = np.rint(Rotation.from_matrix(rotation).as_quat() / QUATERNION_STEP)
    rounded = Rotation.from_quat(quaternion).as_matrix() * mirror
    stretch = (rotation * mirror).T @ grid.affine[:3, :3]  # keeps what shear there is
    stretch = np.rint(stretch / SPACING_STEP_MM) * SPACING_STEP_MM
    middle = (np.array(grid.shape) - 1) / 2
    affine = np.eye(4)
    affine[:3, :3] = rounded @ stretch
    affine[:3, 3] = np.rint(grid.center_mm / CENTER_STEP_MM) * CENTER_STEP_MM - affine[:3, :3] @ middle
    try:
        return VolumeGrid(grid.shape, affine)
    except ValueError:  # rounding flattens axes that nearly lie in a plane; `Stack` refuses them with a message
        return grid


def between(start: VolumeGrid, end: VolumeGrid) -> RigidPose:
    """The motion (one) from a grid to the grid that `settled` made of it, or back."""
    frames = [RigidPose(_nearest_rotation(grid)[0][None], grid.center_mm[None]) for grid in (start, end)]
    return frames[1] @ frames[0].inverse()


def _nearest_rotation(grid: VolumeGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The rotation [3, 3] nearest to the axes, and factors [3] of its columns; the third is -1 for left-handed axes."""
    left, _, right = np.linalg.svd(grid.axes)
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return left @ right * mirror, mirror
