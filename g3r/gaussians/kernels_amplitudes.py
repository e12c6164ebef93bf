"""Numba kernels of the linear map from peaks to pixels: pairs set up once, swept many times."""

from __future__ import annotations

import numba
import numpy as np

from g3r.gaussians.kernels import clear, load, set_up_plane, strip_columns, strip_rows, sweep_plane, unload
from g3r.gaussians.simd import N_LANES, strip_sum

f32 = np.float32


@numba.njit(parallel=True, cache=True)
def set_up(
    first, last, shapes, rotation, center, gain, psf, shape, spacing, offset, start, order, cut, exact,
    records, count,
):  # fmt: skip
    """Records of the pairs of planes first to last (not included), and how many each of them has."""
    for k in numba.prange(first, last):
        begin = start[k] - start[first]
        count[k] = set_up_plane(
            shapes, order, start[k], start[k + 1], rotation[k], center[k], psf[k], shape[k], spacing[k],
            gain[k], cut, exact, records[begin : begin + start[k + 1] - start[k]],
        )  # fmt: skip


@numba.njit(parallel=True, cache=True)
def apply(first, last, peak, shape, offset, start, cut, records, count, images, out):
    """A c on planes first to last: the pixels of peaks."""
    n_workers = len(images)
    for worker in numba.prange(n_workers):
        image = images[worker]
        for k in range(first + worker, last, n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            clear(image, n_x, n_y)
            sweep_plane(records[start[k] - start[first] :], count[k], peak, cut, n_x, n_y, image)
            unload(image, out, offset[k], n_x, n_y)


@numba.njit(parallel=True, cache=True)
def apply_adjoint(first, last, pixels, shape, offset, start, cut, records, count, images, buffers):
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
                record = records[start[k] - start[first] + i]
                begin, stop = strip_columns(record, n_y)
                total = f32(0.0)
                for column in range(begin, stop + 1, N_LANES):
                    dy = f32(column) - record.y
                    end = f32(min(column + N_LANES - 1, stop)) - record.y
                    row, n_rows = strip_rows(record, cut, dy, end, n_x)
                    total += strip_sum(
                        image, (record.row + row) * pitch + record.column + column, pitch, n_rows,
                        record.e_0, record.q_x, record.q_u, record.slope, f32(row) - record.x, dy, limit,
                    )  # fmt: skip
                buffer[record.gaussian] += float(record.unit) * total
