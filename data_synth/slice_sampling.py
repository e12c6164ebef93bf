"""Fast sampling of many slices of a truth volume, averaged over pixel and thickness, in compiled loops."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from data_synth.atlas import TruthVolume
from g3r.geometry import RigidPose

Array = NDArray[np.float64]

THROUGH_PLANE = np.array([-1 / 3, 0.0, 1 / 3])
"""Sample positions through the slice in units of its thickness: the centres of the thirds of a box."""
IN_PLANE = np.array([-0.25, 0.25])
"""Sub-samples of a pixel per axis."""
MASK_BLUR_VOXELS = 1.0


@dataclass(frozen=True)
class Head:
    """A truth volume ready for fast sampling.

    Args:
        data: [I, J, K] float32.
        soft_mask: [I, J, K] float32 mask, blurred so that the choice of threshold makes it wider or narrower.
        affine: [4, 4] atlas frame from index.
    """

    data: NDArray[np.float32]
    soft_mask: NDArray[np.float32]
    affine: Array

    @classmethod
    def from_volume(cls, volume: TruthVolume) -> Head:
        """The head of a volume in the atlas frame."""
        soft = gaussian_filter(volume.mask.astype(np.float32), MASK_BLUR_VOXELS)
        return cls(np.ascontiguousarray(volume.data), np.ascontiguousarray(soft), volume.affine)


def sample_slices(
    head: Head,
    index_from_atlas: Array,
    pose: RigidPose,
    thickness_mm: Array,
    pixel_mm: float,
    size: int,
    threshold: float = 0.5,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slice images of a head, averaged over pixel and thickness.

    Args:
        head: the truth.
        index_from_atlas: [4, 4] voxel index from the atlas frame (mm).
        pose: [K] poses that map the frame of each slice (origin at the image's centre) to the atlas frame.
        thickness_mm: [K].
        pixel_mm: edge of the square pixels.
        size: pixels per edge, N.
        threshold: of the soft mask; less makes the head larger.

    Returns:
        Images [K, N, N], zero outside the mask, and the mask's share of each pixel [K, N, N].
    """
    return _sample(
        head.data,
        head.soft_mask,
        *pixel_lines(index_from_atlas, pose),
        np.asarray(thickness_mm, dtype=np.float32),
        np.float32(pixel_mm),
        size,
        np.float32(threshold),
        IN_PLANE.astype(np.float32),
        THROUGH_PLANE.astype(np.float32),
    )


def sample_masks(
    head: Head, index_from_atlas: Array, pose: RigidPose, pixel_mm: float, size: int, threshold: float
) -> NDArray[np.float32]:
    """Mark the pixels whose centres are in the mask.

    Args:
        head: the truth.
        index_from_atlas: [4, 4] voxel index from the atlas frame (mm).
        pose: [K] poses that map the frame of each slice (origin at the image's centre) to the atlas frame.
        pixel_mm: edge of the square pixels.
        size: pixels per edge, N.
        threshold: of the soft mask; less makes the head larger.

    Returns:
        [K, N, N], 0 or 1.
    """
    lines = pixel_lines(index_from_atlas, pose)
    return _sample_mask(head.soft_mask, *lines, np.float32(pixel_mm), size, np.float32(threshold))


def pixel_lines(index_from: NDArray[np.floating], pose: RigidPose) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A slice's axes and origin in the voxel index of a grid, as the compiled loops take them.

    Args:
        index_from: [4, 4] voxel index from the frame of the poses (mm).
        pose: [K] that frame from the slices.

    Returns:
        Columns per mm along each axis of a slice [K, 3, 3], and origins [K, 3].
    """
    linear = index_from[:3, :3]
    origin = pose.translation_mm @ linear.T + index_from[:3, 3]
    return np.ascontiguousarray(linear @ pose.rotation, np.float32), np.ascontiguousarray(origin, np.float32)


@nb.njit(cache=True, fastmath=True)
def _sample_mask(soft_mask, axes, origin, pixel, size, threshold):
    inside = np.zeros((len(origin), size, size), np.float32)
    middle = np.float32((size - 1) / 2)
    for s in range(len(origin)):
        for i in range(size):
            u = (np.float32(i) - middle) * pixel
            for j in range(size):
                v = (np.float32(j) - middle) * pixel
                x = origin[s, 0] + axes[s, 0, 0] * u + axes[s, 0, 1] * v
                y = origin[s, 1] + axes[s, 1, 0] * u + axes[s, 1, 1] * v
                z = origin[s, 2] + axes[s, 2, 0] * u + axes[s, 2, 1] * v
                if trilinear(soft_mask, x, y, z) > threshold:
                    inside[s, i, j] = 1.0
    return inside


@nb.njit(cache=True, fastmath=True)
def trilinear(volume, x, y, z):
    """Trilinear interpolation of a volume at a fractional index, in compiled code; zero outside."""
    if x < 0 or y < 0 or z < 0:
        return np.float32(0)
    i, j, k = int(x), int(y), int(z)
    if i + 1 >= volume.shape[0] or j + 1 >= volume.shape[1] or k + 1 >= volume.shape[2]:
        return np.float32(0)
    a, b, c = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1)
    low = (one - b) * ((one - c) * volume[i, j, k] + c * volume[i, j, k + 1])
    low += b * ((one - c) * volume[i, j + 1, k] + c * volume[i, j + 1, k + 1])
    high = (one - b) * ((one - c) * volume[i + 1, j, k] + c * volume[i + 1, j, k + 1])
    high += b * ((one - c) * volume[i + 1, j + 1, k] + c * volume[i + 1, j + 1, k + 1])
    return (one - a) * low + a * high


@nb.njit(cache=True, fastmath=True)
def _sample(data, soft_mask, axes, origin, thickness, pixel, size, threshold, in_plane, through):
    n = len(origin)
    image = np.zeros((n, size, size), np.float32)
    inside = np.zeros((n, size, size), np.float32)
    share = np.float32(1.0 / in_plane.size**2)
    middle = np.float32((size - 1) / 2)
    for s in range(n):
        for i in range(size):
            for j in range(size):
                for p in in_plane:
                    for q in in_plane:
                        u = (np.float32(i) - middle + p) * pixel
                        v = (np.float32(j) - middle + q) * pixel
                        x = origin[s, 0] + axes[s, 0, 0] * u + axes[s, 0, 1] * v
                        y = origin[s, 1] + axes[s, 1, 0] * u + axes[s, 1, 1] * v
                        z = origin[s, 2] + axes[s, 2, 0] * u + axes[s, 2, 1] * v
                        if trilinear(soft_mask, x, y, z) <= threshold:
                            continue
                        inside[s, i, j] += share
                        total = np.float32(0)
                        for t in through:
                            w = t * thickness[s]
                            total += trilinear(
                                data, x + axes[s, 0, 2] * w, y + axes[s, 1, 2] * w, z + axes[s, 2, 2] * w
                            )
                        image[s, i, j] += share * total / np.float32(through.size)
    return image, inside
