"""Vectorised loops over pixels: they locate pixels in a volume, and read from it or add to it.

Numba checks whether an index is negative, and no loop with such a check or with a branch is vectorised. So a first loop
finds the cells and fractions of a run of pixels of one plane, without a branch, and a second one reads at unsigned
voxel numbers. The volume is flat; pixels outside it lie in a cell whose corners are all zero.
"""

from __future__ import annotations

import numba
import numpy as np

RUN = 512
"""Pixels per run, few enough that their data stay in the nearest cache."""

REORDERED = {"reassoc", "contract", "nsz"}
"""Fast-math flags: sums in any order and fused multiply-adds; not-a-number is preserved."""


@numba.njit(nogil=True, cache=True)
def fill_plane_and_uv(number, offset, shape, spacing, plane, uv):
    """Write plane and in-plane position of pixels; the last plane is tried first, since pixels mostly come in order.

    Args:
        number: [P] pixel numbers, counted over all planes.
        offset: [K + 1] first pixel of each plane, and the total.
        shape: [K, 2] pixels along x and y.
        spacing: [K, 2] (mm).
        plane: [P], written.
        uv: [P, 2] (mm from the plane's centre), written.
    """
    k = 0
    for p in range(len(number)):
        pixel = number[p]
        if not offset[k] <= pixel < offset[k + 1]:
            k = np.searchsorted(offset, pixel, side="right") - 1
        row = (pixel - offset[k]) // shape[k, 1]
        column = pixel - offset[k] - row * shape[k, 1]
        plane[p] = k
        uv[p, 0] = (row - (shape[k, 0] - 1) / 2) * spacing[k, 0]
        uv[p, 1] = (column - (shape[k, 1] - 1) / 2) * spacing[k, 1]


@numba.njit(nogil=True, cache=True, fastmath=REORDERED)
def locate(u, v, matrix, origin, shape, outside, cell, fraction):
    """Find the cell of each pixel and its position in the cell.

    Args:
        u: [P] in-plane positions along x (mm).
        v: [P] along y.
        matrix: [3, 3] index from plane.
        origin: [3] index of the plane's centre.
        shape: [3] of the volume, as reals.
        outside: number of the cell for pixels outside.
        cell: [P] number of the lowest corner, written.
        fraction: [3, P] position in the cell from that corner, written.
    """
    real = u.dtype.type
    zero, one = real(0), real(1)
    m_xu, m_xv, m_yu, m_yv, m_zu, m_zv = (
        matrix[0, 0],
        matrix[0, 1],
        matrix[1, 0],
        matrix[1, 1],
        matrix[2, 0],
        matrix[2, 1],
    )
    o_x, o_y, o_z = origin[0], origin[1], origin[2]
    end_x, end_y, end_z = shape[0] - one, shape[1] - one, shape[2] - one
    stride_x, stride_y = np.int32(shape[1] * shape[2]), np.int32(shape[2])
    beyond = np.int32(outside)
    in_x, in_y, in_z = fraction[0], fraction[1], fraction[2]
    for p in range(len(u)):
        x, y, z = o_x + m_xu * u[p] + m_xv * v[p], o_y + m_yu * u[p] + m_yv * v[p], o_z + m_zu * u[p] + m_zv * v[p]
        inside = (x >= zero) & (x < end_x) & (y >= zero) & (y < end_y) & (z >= zero) & (z < end_z)
        x, y, z = x if inside else zero, y if inside else zero, z if inside else zero
        i, j, h = np.int32(x), np.int32(y), np.int32(z)
        in_x[p], in_y[p], in_z[p] = x - real(i), y - real(j), z - real(h)
        cell[p] = i * stride_x + j * stride_y + h if inside else beyond


@numba.njit(nogil=True, cache=True)
def end_of_run(plane, first, last):
    """End of the run that starts at `first`: at another plane, after `RUN` pixels, or at `last`."""
    end = first + 1
    while end < last and end < first + RUN and plane[end] == plane[first]:
        end += 1
    return end


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=REORDERED)
def gather(flat, shape, plane, uv, matrix, origin, node_weight, pixels):
    """Add to each pixel the weighted values of the volume at its nodes.

    Args:
        flat: the volume with a margin of one zero on every side.
        shape: [3] of it, as reals.
        plane: [P] of each pixel.
        uv: [2, P] in-plane positions (mm).
        matrix: [K, 3, 3] index from plane.
        origin: [K, Q, 3] index of each node of a pixel in the middle of the plane.
        node_weight: [Q].
        pixels: [P], changed.
    """
    to_x, to_y, to_z = np.uint64(shape[1] * shape[2]), np.uint64(shape[2]), np.uint64(1)
    n_parts = (len(plane) + RUN - 1) // RUN
    for part in numba.prange(n_parts):
        cell, fraction = np.empty(RUN, np.int32), np.empty((3, RUN), uv.dtype)
        first, last = part * RUN, min((part + 1) * RUN, len(plane))
        while first < last:
            end = end_of_run(plane, first, last)
            k, own = plane[first], pixels[first:end]
            for q in range(len(node_weight)):
                locate(uv[0, first:end], uv[1, first:end], matrix[k], origin[k, q], shape, 0, cell, fraction)
                weight = node_weight[q]
                for p in range(len(own)):
                    c = np.uint64(cell[p])
                    fx, fy, fz = fraction[0, p], fraction[1, p], fraction[2, p]
                    v00 = flat[c] + fz * (flat[c + to_z] - flat[c])
                    v01 = flat[c + to_y] + fz * (flat[c + to_y + to_z] - flat[c + to_y])
                    v10 = flat[c + to_x] + fz * (flat[c + to_x + to_z] - flat[c + to_x])
                    v11 = flat[c + to_x + to_y] + fz * (flat[c + to_x + to_y + to_z] - flat[c + to_x + to_y])
                    v0, v1 = v00 + fy * (v01 - v00), v10 + fy * (v11 - v10)
                    own[p] += weight * (v0 + fx * (v1 - v0))
            first = end


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=REORDERED)
def scatter(pixels, shape, plane, uv, matrix, origin, node_weight, buffers):
    """Add each pixel to a volume at its nodes, with the weights of `gather`.

    Args:
        pixels: [P].
        shape: [3] of the volume with its margin, as reals.
        plane: [P] of each pixel.
        uv: [2, P] in-plane positions (mm).
        matrix: [K, 3, 3] index from plane.
        origin: [K, Q, 3] index of each node of a pixel in the middle of the plane.
        node_weight: [Q].
        buffers: [B, voxels] one flat volume for each thread, changed; pixels outside are added to its first voxel.
    """
    to_x, to_y, to_z = np.uint64(shape[1] * shape[2]), np.uint64(shape[2]), np.uint64(1)
    n_buffers, n = len(buffers), len(plane)
    for part in numba.prange(n_buffers):
        flat = buffers[part]
        cell, fraction = np.empty(RUN, np.int32), np.empty((3, RUN), uv.dtype)
        first, last = part * n // n_buffers, (part + 1) * n // n_buffers
        while first < last:
            end = end_of_run(plane, first, last)
            k, own = plane[first], pixels[first:end]
            for q in range(len(node_weight)):
                locate(uv[0, first:end], uv[1, first:end], matrix[k], origin[k, q], shape, 0, cell, fraction)
                weight = node_weight[q]
                for p in range(len(own)):
                    c = np.uint64(cell[p])
                    fx, fy, fz = fraction[0, p], fraction[1, p], fraction[2, p]
                    whole = weight * own[p]
                    w1 = whole * fx
                    w0 = whole - w1
                    w01, w11 = w0 * fy, w1 * fy
                    w00, w10 = w0 - w01, w1 - w11
                    z00, z01, z10, z11 = w00 * fz, w01 * fz, w10 * fz, w11 * fz
                    flat[c] += w00 - z00
                    flat[c + to_z] += z00
                    flat[c + to_y] += w01 - z01
                    flat[c + to_y + to_z] += z01
                    flat[c + to_x] += w10 - z10
                    flat[c + to_x + to_z] += z10
                    flat[c + to_x + to_y] += w11 - z11
                    flat[c + to_x + to_y + to_z] += z11
            first = end


@numba.njit(parallel=True, nogil=True, cache=True)
def fill_world(plane, uv, rotation, center, position):
    """Write the world positions of pixels.

    Args:
        plane: [P] of each pixel.
        uv: [P, 2] (mm from the plane's centre).
        rotation: [K, 3, 3] world from plane.
        center: [K, 3] (mm).
        position: [P, 3] (mm), written.
    """
    for p in numba.prange(len(plane)):
        k = plane[p]
        for axis in range(3):
            position[p, axis] = center[k, axis] + uv[p, 0] * rotation[k, axis, 0] + uv[p, 1] * rotation[k, axis, 1]
