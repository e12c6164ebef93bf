"""Numba kernels of the linear map from amplitudes to pixels: pairs set up once, swept many times."""

from __future__ import annotations

import numba
import numpy as np

from g3r.gaussians.kernels import clear, load, rasterise_plane, set_up_plane, strip_columns, strip_rows, unload
from g3r.gaussians.simd import N_LANES, strip_sum

f32 = np.float32


@numba.njit(parallel=True, cache=True)
def set_up(
    first,
    last,
    shapes,
    rotation,
    center,
    gain,
    psf,
    shape,
    spacing,
    offset,
    start,
    order,
    cut,
    exact,
    projections,
    count,
):
    """Records of the pairs of planes first to last (not included), and how many each of them has."""
    for k in numba.prange(first, last):
        begin = start[k] - start[first]
        count[k] = set_up_plane(
            shapes,
            order,
            start[k],
            start[k + 1],
            rotation[k],
            center[k],
            psf[k],
            shape[k],
            spacing[k],
            gain[k],
            cut,
            exact,
            projections[begin : begin + start[k + 1] - start[k]],
        )


@numba.njit(parallel=True, cache=True)
def apply(first, last, amplitude, shape, offset, start, cut, projections, count, images, out):
    """A c on planes first to last: the pixels of amplitudes."""
    n_workers = len(images)
    for worker in numba.prange(n_workers):
        image = images[worker]
        for k in range(first + worker, last, n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            clear(image, n_x, n_y)
            rasterise_plane(projections[start[k] - start[first] :], count[k], amplitude, cut, n_x, n_y, image)
            unload(image, out, offset[k], n_x, n_y)


@numba.njit(parallel=True, cache=True)
def apply_adjoint(first, last, pixels, shape, offset, start, cut, projections, count, images, buffers):
    """A^T y of the pixels of planes first to last, added to buffers [n_workers, N]."""
    n_workers = len(images)
    limit = f32(-0.5 * cut)
    for worker in numba.prange(n_workers):
        image, buffer = images[worker], buffers[worker]
        for k in range(first + worker, last, n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            load(image, pixels, offset[k], n_x, n_y)
            pitch = n_y + N_LANES
            for i in range(count[k]):
                record = projections[start[k] - start[first] + i]
                begin, stop = strip_columns(record, n_y)
                total = f32(0.0)
                for column in range(begin, stop + 1, N_LANES):
                    dy = f32(column) - record.y
                    end = f32(min(column + N_LANES - 1, stop)) - record.y
                    row, n_rows = strip_rows(record, cut, dy, end, n_x)
                    total += strip_sum(
                        image,
                        (record.row + row) * pitch + record.column + column,
                        pitch,
                        n_rows,
                        record.e_0,
                        record.q_x,
                        record.q_u,
                        record.slope,
                        f32(row) - record.x,
                        dy,
                        limit,
                    )
                buffer[record.gaussian] += float(record.unit) * total
