"""Numba kernels of the linear map from amplitudes to pixels: projected once, rasterised many times.

`part` is a range of planes (first, one past the last). `held` is the named tuple of their projections. Other arguments
as in `kernels`.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.gaussians.kernels import clear, load, project, rasterise, strip_at, strip_columns, unload
from g3r.gaussians.simd import N_LANES, strip_sum

f32 = np.float32


class HeldProjections(NamedTuple):
    """Projections onto a range of planes.

    Attributes:
        start: [K + 1] of the overlap list; plane k begins at `start[k] - start[first]`.
        projections: room for the projections of the whole range.
        n_touching: [K] number of projections on each plane.
    """

    start: NDArray[np.int64]
    projections: NDArray[np.void]
    n_touching: NDArray[np.int64]


@numba.njit(parallel=True, nogil=True, cache=True)
def set_up(part, shapes, planes, overlaps, cut, projections, n_touching):
    """Project the Gaussians onto the planes of a part; writes `projections` and `n_touching`, the arrays of `held`."""
    first, last = part
    start = overlaps.start
    for k in numba.prange(first, last):
        begin, end = start[k] - start[first], start[k + 1] - start[first]
        n_touching[k] = project(shapes, planes, overlaps, k, cut, True, projections[begin:end])


@numba.njit(parallel=True, nogil=True, cache=True)
def apply(part, amplitude, planes, cut, held, images, out):
    """A c: the pixels of amplitudes on the planes of a part."""
    first, last = part
    n_workers = len(images)
    for worker in numba.prange(n_workers):
        image = images[worker]
        for k in range(first + worker, last, n_workers):
            n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
            clear(image, n_x, n_y)
            begin = held.start[k] - held.start[first]
            rasterise(held.projections[begin:], held.n_touching[k], amplitude, cut, n_x, n_y, image)
            unload(image, out, planes.offset[k], n_x, n_y)


@numba.njit(parallel=True, nogil=True, cache=True)
def apply_adjoint(part, pixels, planes, cut, held, images, buffers):
    """A^T y of the pixels of a part, added to buffers [n_workers, N]."""
    first, last = part
    n_workers = len(images)
    limit = f32(-0.5 * cut)
    for worker in numba.prange(n_workers):
        image, buffer = images[worker], buffers[worker]
        for k in range(first + worker, last, n_workers):
            n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
            load(image, pixels, planes.offset[k], n_x, n_y)
            pitch = n_y + N_LANES
            for i in range(held.n_touching[k]):
                p = held.projections[held.start[k] - held.start[first] + i]
                begin, stop = strip_columns(p, n_y)
                total = f32(0.0)
                for column in range(begin, stop + 1, N_LANES):
                    at, n_rows, dx, dy = strip_at(p, cut, column, stop, n_x, pitch)
                    total += strip_sum(image, at, pitch, n_rows, p.e_0, p.q_x, p.q_u, p.slope, dx, dy, limit)
                buffer[p.gaussian] += float(p.unit) * total
