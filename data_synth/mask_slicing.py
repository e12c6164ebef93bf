"""Slicing of a head in its surroundings, in compiled loops: two grids, each with its own poses of the slices."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from data_synth.slice_sampling import pixel_lines, trilinear
from g3r.geometry import RigidPose


def image_slices(
    head: NDArray[np.float32],
    index_from_head: NDArray[np.floating],
    head_pose: RigidPose,
    behind: NDArray[np.float32],
    index_from_scan: NDArray[np.floating],
    scan_pose: RigidPose,
    *,
    first_mm: tuple[float, float],
    pixel_mm: float,
    shape: tuple[int, int],
    thickness_mm: float,
    n_through: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Images of slices, and the share of each pixel in the mask.

    Args:
        head: [I, J, K, 3] intensity times opacity, opacity, and share in the mask, on the head's grid.
        index_from_head: [4, 4] voxel index of the head's grid from the head's frame (mm).
        head_pose: [S] poses that map the frame of each slice to the head's frame.
        behind: [N, N, N] intensities of the surroundings.
        index_from_scan: [4, 4] voxel index of the surroundings' grid from the scan's frame (mm).
        scan_pose: [S] poses that map the frame of each slice to the scan's frame.
        first_mm: position of the first pixel's centre in the slice.
        pixel_mm: edge of the square pixels.
        shape: pixels along both axes.
        thickness_mm: of a slice.
        n_through: samples through the slice.

    Returns:
        Images and shares, each [*shape, S].
    """
    depth = ((np.arange(n_through) + 0.5) / n_through - 0.5) * thickness_mm
    return _slices(
        head,
        *pixel_lines(index_from_head, head_pose),
        behind,
        *pixel_lines(index_from_scan, scan_pose),
        np.array(first_mm, np.float32),
        np.float32(pixel_mm),
        shape[0],
        shape[1],
        depth.astype(np.float32),
    )


@nb.njit(cache=True, fastmath=True)
def _slices(head, axes, origin, behind, behind_axes, behind_origin, first, pixel, n_i, n_j, depth):
    n_slices = len(origin)
    image = np.zeros((n_i, n_j, n_slices), np.float32)
    inside = np.zeros((n_i, n_j, n_slices), np.float32)
    share = np.float32(1.0 / depth.size)
    for s in range(n_slices):
        for i in range(n_i):
            u = first[0] + np.float32(i) * pixel
            for j in range(n_j):
                v = first[1] + np.float32(j) * pixel
                total, mask = np.float32(0), np.float32(0)
                for w in depth:
                    opacity = np.float32(0)
                    x = origin[s, 0] + axes[s, 0, 0] * u + axes[s, 0, 1] * v + axes[s, 0, 2] * w
                    y = origin[s, 1] + axes[s, 1, 0] * u + axes[s, 1, 1] * v + axes[s, 1, 2] * w
                    z = origin[s, 2] + axes[s, 2, 0] * u + axes[s, 2, 1] * v + axes[s, 2, 2] * w
                    if x >= 0 and y >= 0 and z >= 0:
                        a, b, c = int(x), int(y), int(z)
                        if a + 1 < head.shape[0] and b + 1 < head.shape[1] and c + 1 < head.shape[2]:
                            p, q, r = x - np.float32(a), y - np.float32(b), z - np.float32(c)
                            for da in range(2):
                                wa = p if da else np.float32(1) - p
                                for db in range(2):
                                    wb = wa * (q if db else np.float32(1) - q)
                                    for dc in range(2):
                                        wc = wb * (r if dc else np.float32(1) - r)
                                        total += wc * head[a + da, b + db, c + dc, 0]
                                        opacity += wc * head[a + da, b + db, c + dc, 1]
                                        mask += wc * head[a + da, b + db, c + dc, 2]
                    if opacity < np.float32(0.999):
                        x = behind_origin[s, 0] + behind_axes[s, 0, 0] * u + behind_axes[s, 0, 1] * v
                        y = behind_origin[s, 1] + behind_axes[s, 1, 0] * u + behind_axes[s, 1, 1] * v
                        z = behind_origin[s, 2] + behind_axes[s, 2, 0] * u + behind_axes[s, 2, 1] * v
                        x += behind_axes[s, 0, 2] * w
                        y += behind_axes[s, 1, 2] * w
                        z += behind_axes[s, 2, 2] * w
                        total += (np.float32(1) - opacity) * trilinear(behind, x, y, z)
                image[i, j, s] = total * share
                inside[i, j, s] = mask * share
    return image, inside
