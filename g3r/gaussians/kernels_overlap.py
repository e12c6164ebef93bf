"""Numba kernels that find which Gaussians may touch which planes."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.gaussians.kernels import LOOSE

f32 = np.float32

SLACK_MM = 1e-4
"""Bound of the float32 error in the distance of a Gaussian from a plane of the same scene."""

VARIANCE_SLACK = 1e-6
"""Bound of the float32 error in a variance along an axis, over the trace; for a flat Gaussian it is all of it."""


class PlaneExtents(NamedTuple):
    """Rectangles in space, float32: rotation [K, 3, 3], center [K, 3], psf variances [K, 3], half the sides [K, 3]."""

    rotation: NDArray[np.float32]
    center: NDArray[np.float32]
    psf: NDArray[np.float32]
    half: NDArray[np.float32]


@numba.njit(parallel=True, nogil=True, cache=True)
def columns_of(shapes, middle, columns):
    """Mean and covariance as rows [9, N] of float32, so that the search runs in vectors.

    Args:
        shapes: [N, 10] of `derive_shapes`.
        middle: [3] mm, what means are relative to.
        columns: [9, N], written.
    """
    for j in numba.prange(len(shapes)):
        for n in range(3):
            columns[n, j] = shapes[j, n] - middle[n]
        for n in range(3, 9):
            columns[n, j] = shapes[j, n]


@numba.njit(fastmath=LOOSE, error_model="numpy")
def _mark(columns, r, t, psf, half, cut, marks):
    """1 for each Gaussian whose ellipsoid at the cut-off may touch a plane's rectangle, else 0."""
    x, y, z, xx, xy = columns[0], columns[1], columns[2], columns[3], columns[4]
    xz, yy, yz, zz = columns[5], columns[6], columns[7], columns[8]
    for j in range(len(x)):
        dx, dy, dz = x[j] - t[0], y[j] - t[1], z[j] - t[2]
        slack = f32(SLACK_MM) + f32(1e-6) * (abs(dx) + abs(dy) + abs(dz))
        variance_slack = f32(VARIANCE_SLACK) * (xx[j] + yy[j] + zz[j])
        touches = True
        for axis in range(3):
            a, b, c = r[0, axis], r[1, axis], r[2, axis]
            m = dx * a + dy * b + dz * c
            s = (
                xx[j] * a * a
                + yy[j] * b * b
                + zz[j] * c * c
                + f32(2.0) * (xy[j] * a * b + xz[j] * a * c + yz[j] * b * c)
                + psf[axis]
                + variance_slack
            )
            reach = max(abs(m) - slack - half[axis], f32(0.0))
            touches &= reach * reach <= cut * s
        marks[j] = touches


@numba.njit(parallel=True, nogil=True, cache=True)
def find(columns, planes, cut, marks, start, order):
    """Write the numbers of the Gaussians of each plane, ascending, into `order`; an empty `order` counts them only.

    Called twice: the first call makes start [K + 1], the second fills order [start[K]].

    Args:
        columns: [9, N] float32 of `columns_of`.
        planes: `PlaneExtents`.
        cut: square of the cut-off in sigma.
        marks: [n_workers, N] scratch space.
        start: [K + 1] where each plane's Gaussians begin.
        order: the numbers of the Gaussians.
    """
    n_workers, n_planes = len(marks), len(planes.rotation)
    counting = len(order) == 0
    for worker in numba.prange(n_workers):
        mark = marks[worker]
        for k in range(worker, n_planes, n_workers):
            _mark(columns, planes.rotation[k], planes.center[k], planes.psf[k], planes.half[k], cut, mark)
            if counting:
                n = 0
                for j in range(len(mark)):
                    n += mark[j]
                start[k + 1] = n
            else:
                n = start[k]
                for j in range(len(mark)):
                    if mark[j]:
                        order[n] = j
                        n += 1
    if counting:
        for k in range(n_planes):
            start[k + 1] += start[k]
