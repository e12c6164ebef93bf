"""The loops over voxels of the least-squares solvers."""

from __future__ import annotations

import numba


@numba.njit(parallel=True, nogil=True, cache=True)
def join(buffers, volume):
    """Write the sum of what threads have scattered, without its margin.

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
                out[x, y, z] = total
