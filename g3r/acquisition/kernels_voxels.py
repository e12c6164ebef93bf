"""Loops over voxels for the least-squares solvers."""

from __future__ import annotations

import numba


@numba.njit(parallel=True, nogil=True, cache=True)
def join(buffers, volume):
    """Write the sum of the buffers that threads scattered into, without the margin.

    Args:
        buffers: [B, I + 2, J + 2, K + 2].
        volume: [I, J, K], written.
    """
    n_x, n_y, n_z = volume.shape
    for x in numba.prange(n_x):
        for y in range(n_y):
            for z in range(n_z):
                volume[x, y, z] = buffers[0, x + 1, y + 1, z + 1]
        for b in range(1, len(buffers)):
            for y in range(n_y):
                for z in range(n_z):
                    volume[x, y, z] += buffers[b, x + 1, y + 1, z + 1]


@numba.njit(inline="always")
def divergence_at(volume, weight, weighted, x, y, z):
    """One voxel of D^T W D V, see `fill_divergence`."""
    n_x, n_y, n_z = volume.shape
    here, total = volume[x, y, z], volume.dtype.type(0)
    own = weight[x, y, z] if weighted else volume.dtype.type(1)
    if x + 1 < n_x:
        total += own * (here - volume[x + 1, y, z])
    if y + 1 < n_y:
        total += own * (here - volume[x, y + 1, z])
    if z + 1 < n_z:
        total += own * (here - volume[x, y, z + 1])
    if x > 0:
        total += (weight[x - 1, y, z] if weighted else own) * (here - volume[x - 1, y, z])
    if y > 0:
        total += (weight[x, y - 1, z] if weighted else own) * (here - volume[x, y - 1, z])
    if z > 0:
        total += (weight[x, y, z - 1] if weighted else own) * (here - volume[x, y, z - 1])
    return total


@numba.njit(parallel=True, nogil=True, cache=True)
def fill_divergence(volume, weight, weighted, out):
    """Write D^T W D V with forward differences D and free edges.

    Args:
        volume: [I, J, K].
        weight: [I, J, K], not read unless `weighted`.
        weighted: whether voxels have weights.
        out: [I, J, K], written.
    """
    n_x, n_y, n_z = volume.shape
    for x in numba.prange(n_x):
        for y in range(n_y):
            for z in range(n_z):
                out[x, y, z] = divergence_at(volume, weight, weighted, x, y, z)


@numba.njit(parallel=True, nogil=True, cache=True)
def add_roughness(volume, strength, image, along):
    """Add s D^T D V to the image of V under a linear system, and multiply the sum with V.

    Args:
        volume: [I, J, K].
        strength: s.
        image: [I, J, K], changed.
        along: [I] float64, written: the product summed over each plane of voxels, so that threads do not change it.
    """
    n_x, n_y, n_z = volume.shape
    for x in numba.prange(n_x):
        total = 0.0
        for y in range(n_y):
            for z in range(n_z):
                image[x, y, z] += strength * divergence_at(volume, volume, False, x, y, z)
                total += volume[x, y, z] * image[x, y, z]
        along[x] = total


@numba.njit(parallel=True, nogil=True, cache=True)
def descend(volume, residual, direction, image, step, square):
    """Take one step of conjugate gradients.

    Args:
        volume: [I, J, K], changed.
        residual: [I, J, K], changed.
        direction: [I, J, K].
        image: [I, J, K] of the direction, under the system.
        step: length of the step.
        square: [I] float64, the residual's sum of squares over each plane of voxels, written.
    """
    n_x, n_y, n_z = volume.shape
    for x in numba.prange(n_x):
        total = 0.0
        for y in range(n_y):
            for z in range(n_z):
                volume[x, y, z] += step * direction[x, y, z]
                left = residual[x, y, z] - step * image[x, y, z]
                residual[x, y, z] = left
                total += left * left
        square[x] = total


@numba.njit(parallel=True, nogil=True, cache=True)
def turn(direction, residual, share):
    """Write the next conjugate-gradient direction: the residual plus a share of the last direction.

    Args:
        direction: [I, J, K], changed.
        residual: [I, J, K].
        share: factor of the last direction.
    """
    n_x, n_y, n_z = direction.shape
    for x in numba.prange(n_x):
        for y in range(n_y):
            for z in range(n_z):
                direction[x, y, z] = residual[x, y, z] + share * direction[x, y, z]
