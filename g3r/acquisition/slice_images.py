"""Slices as small square images of one pixel size, the input of the pose network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose

SUBPIXELS = 2
"""Every acquired pixel is sampled at this many points per axis, so that averages over large pixels are even."""


@dataclass(frozen=True, kw_only=True)
class SliceImages:
    """K slices of one head as masked images, and the geometry that does not depend on the scanner's axes.

    All slices of a stack are cut out around the same in-plane point, the centroid of the stack by its header,
    so that an image also shows where in the field of view of its stack the head is.

    Args:
        image: [K, N, N] float32; first axis along the slice's x, second along y; zero outside the mask, the
            99th percentile in the mask of all slices is 1.
        area_mm2: [K] what the mask covers.
        position_mm: [K] along the stack's normal, from the stack's centroid.
        thickness_mm: [K].
        time_rank: [K] order of acquisition in the stack, 0 first and 1 last; NaN where it is not known.
        stack_id: [K] 0, 1, ... without gaps.
        header_rotation: [K, 3, 3] world from slice by the header. Only rotations between stacks are used.
        frame_in_slice: poses [K] of the image's centre and axes in the slice's own frame.
    """

    image: NDArray[np.float32]
    area_mm2: NDArray[np.float64]
    position_mm: NDArray[np.float64]
    thickness_mm: NDArray[np.float64]
    time_rank: NDArray[np.float64]
    stack_id: NDArray[np.int64]
    header_rotation: NDArray[np.float64]
    frame_in_slice: RigidPose

    def __post_init__(self) -> None:
        n = len(self.image)
        for name in self.__dataclass_fields__:
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries; expected {n}")

    def __len__(self) -> int:
        return len(self.image)


def batch_arrays(sets: Sequence[SliceImages]) -> dict[str, NDArray[Any]]:
    """The slices of several heads as the arrays of one batch, at inference and in training.

    Stacks are numbered across all heads. `g3r.pose_network.network.SliceBatch` lists names and shapes.
    """
    batch: dict[str, NDArray[Any]] = {
        name: np.concatenate([getattr(one, name) for one in sets]).astype(np.float32)
        for name in ("image", "area_mm2", "position_mm", "thickness_mm", "time_rank", "header_rotation")
    }
    batch["image"] = batch["image"][:, None]
    n_stacks = [int(one.stack_id.max()) + 1 for one in sets]
    first = np.cumsum([0, *n_stacks])
    batch["stack"] = np.concatenate([one.stack_id + first[k] for k, one in enumerate(sets)])
    batch["set_of_stack"] = np.repeat(np.arange(len(sets)), n_stacks)
    return batch


def slice_images(slices: Slices, pixel_mm: float, size: int) -> SliceImages:
    """The slices at their header poses, averaged over pixels of one size.

    Args:
        slices: of all stacks, cropped to `size` pixels around the centroid of their stack.
        pixel_mm: edge of the square pixels.
        size: N, pixels per edge.
    """
    planes, pixel, plane = slices.planes, slices.pixel_index, slices.pixel_plane
    _, stack_id = np.unique(slices.stack_id, return_inverse=True)
    uv = planes.pixel_uv_mm()[pixel]
    area = np.bincount(plane, minlength=len(slices)) * planes.pixel_area_mm2

    # positions in the frame of each stack's first slice; by the header all slices of a stack are parallel
    first = np.array([np.flatnonzero(stack_id == s)[0] for s in range(stack_id.max() + 1)])[stack_id]
    in_stack = slices.header_pose.take(first).inverse() @ slices.header_pose
    center = np.stack(
        [
            np.bincount(plane, uv[:, a], len(slices)) / np.maximum(np.bincount(plane, minlength=len(slices)), 1)
            for a in range(2)
        ]
        + [np.zeros(len(slices))],
        axis=1,
    )
    center = in_stack.apply(center)
    weight = np.bincount(stack_id, area)
    centroid = np.stack([np.bincount(stack_id, area * center[:, a]) / weight for a in range(3)], axis=1)
    relative = centroid[stack_id] - in_stack.translation_mm
    shift = np.einsum("kji,kj->ki", in_stack.rotation, relative)
    frame = RigidPose.from_rotvec(np.zeros((len(slices), 3)), shift * [1, 1, 0])

    images = np.zeros(len(slices) * size * size)
    share = planes.pixel_area_mm2[plane] / (pixel_mm * SUBPIXELS) ** 2
    for part in np.ndindex(SUBPIXELS, SUBPIXELS):
        offset = ((np.array(part) + 0.5) / SUBPIXELS - 0.5) * planes.spacing_mm[plane]
        index = np.floor((uv + offset - shift[plane, :2]) / pixel_mm + size / 2).astype(np.int64)
        inside = ((index >= 0) & (index < size)).all(1)
        flat = (plane[inside] * size + index[inside, 0]) * size + index[inside, 1]
        images += np.bincount(flat, (slices.masked_value * share)[inside], len(images))
    bright = float(np.percentile(slices.masked_value, 99)) if len(pixel) else 0.0
    images /= bright if bright > 0 else 1.0
    return SliceImages(
        image=images.reshape(-1, size, size).astype(np.float32),
        area_mm2=area,
        position_mm=-shift[:, 2],
        thickness_mm=slices.thickness_mm,
        time_rank=np.full(len(slices), np.nan),
        stack_id=stack_id.astype(np.int64),
        header_rotation=slices.header_pose.rotation,
        frame_in_slice=frame,
    )
