"""Planes of pixels in space, and the slices of all stacks as one record (the y_k of G3R Eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.kernels import fill_plane_and_uv, fill_world
from g3r.acquisition.psf import FWHM_PER_SIGMA, IN_PLANE_FWHM_PIXELS
from g3r.acquisition.stack_checks import ORTHOGONALITY_TOLERANCE
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import Selection


@dataclass(frozen=True, kw_only=True)
class Planes:
    """K rectangular pixel grids in space.

    Pixel (i, j) of plane k is at R (u_x, u_y, 0) + t with u = (index - (shape - 1) / 2) * spacing. Pixels
    of all planes are numbered plane after plane, inside a plane in C order (j fastest).

    Args:
        rotation: [K, 3, 3]; columns are in-plane x, in-plane y, normal; det +1.
        center_mm: [K, 3].
        spacing_mm: [K, 2].
        shape: [K, 2] number of pixels along x and y.
        psf_var_mm2: [K, 3] variances of the Gaussian PSF along the plane's axes; zero samples a volume.
    """

    rotation: NDArray[np.float64]
    center_mm: NDArray[np.float64]
    spacing_mm: NDArray[np.float64]
    shape: NDArray[np.int64]
    psf_var_mm2: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.rotation)
        for name, trailing, dtype in (
            ("rotation", (3, 3), np.float64),
            ("center_mm", (3,), np.float64),
            ("spacing_mm", (2,), np.float64),
            ("shape", (2,), np.int64),
            ("psf_var_mm2", (3,), np.float64),
        ):
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if array.shape != (n, *trailing):
                raise ValueError(f"{name} has shape {array.shape}; expected {(n, *trailing)}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
            object.__setattr__(self, name, array)
        if n and (self.spacing_mm.min() <= 0 or self.shape.min() < 1 or self.psf_var_mm2.min() < 0):
            raise ValueError("planes need a positive spacing and shape and a PSF variance of at least zero")

    def __len__(self) -> int:
        return len(self.rotation)

    def __repr__(self) -> str:
        return f"Planes({len(self)} planes, {self.n_pixels} pixels)"

    @cached_property
    def offset(self) -> NDArray[np.int64]:
        """Number of the first pixel of each plane, and the total at the end [K + 1]."""
        return np.concatenate([[0], np.cumsum(self.shape[:, 0] * self.shape[:, 1])]).astype(np.int64)

    @property
    def n_pixels(self) -> int:
        """Number of pixels of all planes."""
        return int(self.offset[-1])

    @property
    def pixel_area_mm2(self) -> NDArray[np.float64]:
        """Area of a pixel of each plane [K]."""
        return self.spacing_mm.prod(1)

    @property
    def pose(self) -> RigidPose:
        """Poses of the planes (world from plane)."""
        return RigidPose(self.rotation, self.center_mm)

    def plane_id(self) -> NDArray[np.int64]:
        """Plane of every pixel [P]."""
        return np.repeat(np.arange(len(self)), np.diff(self.offset))

    def pixel_uv_mm(self, pixel: NDArray[np.integer] | None = None) -> NDArray[np.float64]:
        """In-plane position (mm from the plane's centre) of every pixel [P, 2], or of those given."""
        return self._plane_and_uv(pixel)[1]

    def pixel_world_mm(self, pixel: NDArray[np.integer] | None = None) -> NDArray[np.float64]:
        """World position [P, 3] of every pixel, or of those with the given numbers."""
        plane, uv = self._plane_and_uv(pixel)
        position = np.empty((len(plane), 3))
        fill_world(plane, uv, self.rotation, self.center_mm, position)
        return position

    def _plane_and_uv(self, pixel: NDArray[np.integer] | None) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        number = np.arange(self.n_pixels) if pixel is None else np.asarray(pixel, np.int64)
        plane, uv = np.empty(len(number), np.int64), np.empty((len(number), 2))
        fill_plane_and_uv(number, self.offset, self.shape, self.spacing_mm, plane, uv)
        return plane, uv

    def take(self, index: Selection) -> Planes:
        """The planes at an index array, a mask or a slice."""
        return Planes(**{field: getattr(self, field)[index] for field in self.__dataclass_fields__})

    def moved(self, pose: RigidPose) -> Planes:
        """The planes after rigid motions [K] (or one) of the world."""
        moved = pose @ self.pose
        return replace(self, rotation=moved.rotation, center_mm=moved.translation_mm)

    def with_pose(self, pose: RigidPose) -> Planes:
        """The same pixel grids at other poses (world from plane)."""
        return replace(self, rotation=pose.rotation, center_mm=pose.translation_mm)

    def corners_mm(self) -> NDArray[np.float64]:
        """The corners of each pixel grid [K, 4, 3] in the plane's own frame."""
        unit = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])
        return np.pad((self.shape * self.spacing_mm)[:, None] * unit, ((0, 0), (0, 0), (0, 1)))


@dataclass(frozen=True, kw_only=True)
class FieldsOfView:
    """Extent of whole slices, of which `Slices` keep only the part around the mask.

    Args:
        extent_mm: [K, 2, 2] lowest and highest in-plane position along x and y, in the frame of the cropped plane.
        spacing_mm: [K] distance to the next slice of the stack along the normal, positive where numbers rise with it.
        n_beyond: [K, 2] number of slices with signal before the first and after the last masked one of a stack, which
            were acquired and hold no brain; zero for all other slices.
    """

    extent_mm: NDArray[np.float64]
    spacing_mm: NDArray[np.float64]
    n_beyond: NDArray[np.int64]

    @classmethod
    def of_planes(cls, planes: Planes) -> FieldsOfView:
        """Fields of view that end with the planes, and no slices beyond them."""
        half = planes.shape * planes.spacing_mm / 2
        n = len(planes)
        return cls(extent_mm=np.stack([-half, half], axis=-1), spacing_mm=np.ones(n), n_beyond=np.zeros((n, 2), int))

    def take(self, index: Selection) -> FieldsOfView:
        """The fields of view at an index array, a mask or a slice."""
        return FieldsOfView(**{field: getattr(self, field)[index] for field in self.__dataclass_fields__})


@dataclass(frozen=True, kw_only=True)
class Slices:
    """The acquired slices of all stacks as one record: planes with their pixels.

    Args:
        planes: [K] planes, cropped to the mask.
        value: [P] float32 pixel values.
        mask: [P] bool, pixels of the brain.
        stack_id: [K] number of the stack.
        slice_index: [K] number of the slice in its stack.
        thickness_mm: [K].
        header_pose: [K] poses by the file's header.
        view: fields of view of the whole slices; None where only the planes are known.
    """

    planes: Planes
    value: NDArray[np.float32]
    mask: NDArray[np.bool_]
    stack_id: NDArray[np.int64]
    slice_index: NDArray[np.int64]
    thickness_mm: NDArray[np.float64]
    header_pose: RigidPose
    view: FieldsOfView | None = None

    def __post_init__(self) -> None:
        for name in set(self.__dataclass_fields__) - {"view"}:
            expected = self.planes.n_pixels if name in ("value", "mask") else len(self.planes)
            if len(getattr(self, name)) != expected:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries; expected {expected}")

    def __len__(self) -> int:
        return len(self.planes)

    def __repr__(self) -> str:
        return f"Slices({len(self)} slices of {self.n_stacks} stacks, {len(self.pixel_index)} masked pixels)"

    @property
    def n_stacks(self) -> int:
        """Number of stacks with at least one slice."""
        return len(np.unique(self.stack_id))

    @property
    def fields_of_view(self) -> FieldsOfView:
        """The fields of view of the whole slices."""
        return FieldsOfView.of_planes(self.planes) if self.view is None else self.view

    @property
    def pixel_volume_mm3(self) -> NDArray[np.float64]:
        """Volume that a pixel of each slice covers [K]: its area times the slice thickness."""
        return self.planes.pixel_area_mm2 * self.thickness_mm

    @property
    def typical_pixel_mm(self) -> float:
        """Cube root of the median volume that a pixel covers, before the scanner interpolated it to smaller ones.

        Its size is that of the narrower in-plane PSF, which is wider than nominal where both axes were interpolated.
        """
        pixels = np.sqrt(self.planes.psf_var_mm2[:, :2]) * FWHM_PER_SIGMA / self.planes.spacing_mm
        interpolation = np.maximum(1, np.round(pixels.min(1) / IN_PLANE_FWHM_PIXELS, 3))
        return float(np.median(self.pixel_volume_mm3 * interpolation**2)) ** (1 / 3)

    @cached_property
    def pixel_index(self) -> NDArray[np.int64]:
        """Numbers of the pixels inside the mask [P']."""
        return np.flatnonzero(self.mask)

    @cached_property
    def pixel_plane(self) -> NDArray[np.int64]:
        """Plane of each pixel inside the mask [P']."""
        return self.planes.plane_id()[self.pixel_index]

    @cached_property
    def masked_value(self) -> NDArray[np.float32]:
        """Values of the pixels inside the mask [P']."""
        return self.value[self.pixel_index]

    def masked_value_without(self, gain: NDArray[np.floating] | None) -> NDArray[np.floating]:
        """Values of the pixels inside the mask [P'] with gains [K] divided out; as they are when None."""
        return self.masked_value if gain is None else self.masked_value / gain[self.pixel_plane]

    def take(self, index: Selection) -> Slices:
        """The slices at an index array or mask, with their pixels."""
        chosen = np.arange(len(self))[index]
        pixels = np.concatenate(
            [np.arange(self.planes.offset[k], self.planes.offset[k + 1]) for k in chosen] or [np.zeros(0, int)]
        )
        return Slices(
            planes=self.planes.take(chosen),
            value=self.value[pixels],
            mask=self.mask[pixels],
            stack_id=self.stack_id[chosen],
            slice_index=self.slice_index[chosen],
            thickness_mm=self.thickness_mm[chosen],
            header_pose=self.header_pose.take(chosen),
            view=None if self.view is None else self.view.take(chosen),
        )

    def with_pose(self, pose: RigidPose) -> Slices:
        """The same slices at other poses (world from plane)."""
        return replace(self, planes=self.planes.with_pose(pose))

    def with_motion(self, motion: RigidPose) -> Slices:
        """The same slices at motions [K] relative to their header poses (world from header)."""
        return self.with_pose(motion @ self.header_pose)

    def scaled(self, factor: float) -> Slices:
        """The same slices with their values multiplied by a factor."""
        return replace(self, value=(self.value * np.float32(factor)).astype(np.float32))

    def without_gain(self, gain: NDArray[np.floating]) -> Slices:
        """The same slices with their values divided by gains [K]."""
        return replace(self, value=(self.value / gain[self.planes.plane_id()]).astype(np.float32))

    def world_from_header(self) -> RigidPose:
        """Motion of each slice: maps a point at its header position to its present one."""
        return self.planes.pose @ self.header_pose.inverse()


def volume_planes(grid: VolumeGrid) -> Planes:
    """The K planes of a volume's third axis, without PSF; their pixels in order are data[:, :, k].

    Raises:
        ValueError: a grid whose axes are more sheared than those of a stack may be (`ORTHOGONALITY_TOLERANCE`).
    """
    if grid.shear > ORTHOGONALITY_TOLERANCE:
        raise ValueError(f"planes need a grid with orthogonal axes; these are sheared (cosine {grid.shear:.2g})")
    n_i, n_j, n_k = grid.shape
    index = np.stack([np.full(n_k, (n_i - 1) / 2), np.full(n_k, (n_j - 1) / 2), np.arange(n_k)], axis=1)
    return Planes(
        rotation=np.tile(grid.plane_frame, (n_k, 1, 1)),
        center_mm=grid.world(index),
        spacing_mm=np.tile(grid.spacing_mm[:2], (n_k, 1)),
        shape=np.tile([n_i, n_j], (n_k, 1)),
        psf_var_mm2=np.zeros((n_k, 3)),
    )


def volume_from_pixels(pixels: NDArray[np.float32], grid: VolumeGrid) -> NDArray[np.float32]:
    """Pixels of `volume_planes(grid)` [P] as a volume [I, J, K]."""
    n_i, n_j, n_k = grid.shape
    return np.ascontiguousarray(pixels.reshape(n_k, n_i, n_j).transpose(1, 2, 0))
