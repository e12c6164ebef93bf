"""Numba kernels of the fit: L1 loss of planes with all its gradients in one pass, penalty, Adam, movement."""

from __future__ import annotations

import math

import numba
import numpy as np

from g3r.gaussians.kernels import clear, rasterise_plane, set_up_plane
from g3r.gaussians.kernels_backward import gather_plane
from g3r.gaussians.simd import N_LANES

f32 = np.float32

SUMS = {"contract", "arcp", "nsz", "reassoc"}
"""Sums over a row may be taken in any order, so that they run in vectors; NaN keeps its meaning."""


@numba.njit(fastmath=SUMS)
def _row(image, row, target, weight, begin, n, factor):
    """Weighted absolute residual of a row of pixels, whose gradient takes the place of the pixels."""
    total = f32(0.0)
    for y in range(n):
        residual = image[row + y] - target[begin + y]
        w = weight[begin + y]
        total += w * abs(residual)
        sign = f32(1.0) if residual > f32(0.0) else f32(-1.0) if residual < f32(0.0) else f32(0.0)
        image[row + y] = factor * w * sign
    return total


@numba.njit(fastmath=SUMS)
def _shaded_row(image, row, target, weight, begin, n, factor, basis, c, slopes):
    """As `_row`, with the pixels under a stack's field exp(sum_n c_n basis_n); adds dL/dc to `slopes`."""
    total = f32(0.0)
    g0 = g1 = g2 = g3 = g4 = f32(0.0)
    for y in range(n):
        p = begin + y
        b0, b1, b2, b3, b4 = basis[0, p], basis[1, p], basis[2, p], basis[3, p], basis[4, p]
        field = _exp(c[0] * b0 + c[1] * b1 + c[2] * b2 + c[3] * b3 + c[4] * b4)
        value = image[row + y] * field
        residual = value - target[p]
        w = weight[p]
        total += w * abs(residual)
        sign = f32(1.0) if residual > f32(0.0) else f32(-1.0) if residual < f32(0.0) else f32(0.0)
        gradient = factor * w * sign
        image[row + y] = gradient * field
        gradient *= value
        g0 += gradient * b0
        g1 += gradient * b1
        g2 += gradient * b2
        g3 += gradient * b3
        g4 += gradient * b4
    slopes[0] += g0
    slopes[1] += g1
    slopes[2] += g2
    slopes[3] += g3
    slopes[4] += g4
    return total


@numba.njit(forceinline=True, fastmath=SUMS)
def _exp(e):
    """exp(e) within 3e-7 relatively for |e| < 2, an intensity factor of 7; finite far beyond."""
    t = e * f32(1 / 16)
    p = f32(1.0) + t * (f32(1.0) + t * (f32(0.5) + t * (f32(1 / 6) + t * (f32(1 / 24) + t * f32(1 / 120)))))
    p = p * p
    p = p * p
    p = p * p
    return p * p


@numba.njit(parallel=True, cache=True)
def image_l1(
    shapes,
    amplitude,
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
    images,
    projections,
    target,
    weight,
    slice_weight,
    factor,
    with_pose,
    basis,
    coefficients,
    buffers,
    plane_gradient,
    field_gradient,
    residual,
):
    """L1 of rendered planes and its gradients, plane after plane: each is rendered, compared and gathered.

    The loss is factor sum_k trust_k residual_k with residual_k the sum of weight |pixel - target| over plane
    k (written to `residual`). Gradients are added to buffers [n_workers, N, 11] and written to
    plane_gradient [K, 7] and field_gradient [K, 5]. basis [5, P] and coefficients [K, 5] give the planes'
    fields; an empty basis means that there are none. target, weight, basis are read from offset [K] on.
    """
    n_workers = len(images)
    for worker in numba.prange(n_workers):
        image, mine = images[worker], projections[worker]
        for k in range(worker, len(rotation), n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            pitch = n_y + N_LANES
            clear(image, n_x, n_y)
            n = set_up_plane(
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
                mine,
            )
            rasterise_plane(mine, n, amplitude, cut, n_x, n_y, image)
            total, scale = 0.0, f32(factor * slice_weight[k])
            slopes = field_gradient[k]
            slopes[:] = 0.0
            for x in range(n_x):
                row, begin = x * pitch, offset[k] + x * n_y
                if basis.shape[1]:
                    total += _shaded_row(image, row, target, weight, begin, n_y, scale, basis, coefficients[k], slopes)
                else:
                    total += _row(image, row, target, weight, begin, n_y, scale)
                image[row + n_y : row + pitch] = f32(0.0)
            image[n_x * pitch : n_x * pitch + N_LANES] = f32(0.0)
            residual[k] = total
            plane_gradient[k] = 0.0
            if scale != f32(0.0):
                gather_plane(
                    mine,
                    n,
                    shapes,
                    amplitude,
                    rotation[k],
                    center[k],
                    psf[k],
                    shape[k],
                    spacing[k],
                    cut,
                    exact,
                    image,
                    buffers[worker],
                    plane_gradient[k],
                    with_pose,
                )


@numba.njit(parallel=True, cache=True, fastmath=SUMS)
def scale_penalty(log_scale, seed, factor, gradient):
    """Sum of (log_scale - seed)^2; adds factor times its gradient to that of the log-scales [N, 3]."""
    total = 0.0
    for j in numba.prange(len(log_scale)):
        for a in range(3):
            away = log_scale[j, a] - seed[j, a]
            gradient[j, a] += f32(2.0 * factor) * away
            total += away * away
    return total


@numba.njit(parallel=True, cache=True, fastmath=SUMS)
def adam(values, gradient, first, second, step, beta_1, beta_2, correction, root_correction):
    """One step of Adam (Kingma and Ba 2015, Algorithm 1); returns how many gradients are not finite.

    correction is 1 - beta_1^t and root_correction sqrt(1 - beta_2^t).
    """
    length, decay_1, decay_2 = f32(step / correction), f32(beta_1), f32(beta_2)
    over_root = f32(1.0 / root_correction)
    n_bad = 0
    for i in numba.prange(len(values)):
        g = gradient[i]
        if not abs(g) < f32(3e38):
            n_bad += 1
        m = first[i] + (g - first[i]) * (f32(1.0) - decay_1)
        v = second[i] * decay_2 + (f32(1.0) - decay_2) * g * g
        first[i] = m
        second[i] = v
        values[i] -= length * m / (math.sqrt(v) * over_root + f32(1e-8))
    return n_bad


@numba.njit(parallel=True, cache=True)
def farthest_move(mean, log_scale, quaternion, then, cutoff_sigma, common_mm, min_psf_mm2):
    """Largest change that a pair's distance from its cut-off can have seen, in units of its sigma.

    `then` [N, 12] is what `remember` wrote. With n a unit vector, the distance along n changes by at most
    |mean - then| + common_mm (what planes moved), and sigma_n = sqrt(n^T Sigma n + D) by at most
    max|s - s_then| + angle (s_max - s_min), the steepest that |S n| can be on the unit sphere. sigma_n
    is at least sqrt(s_min^2 + min_psf_mm2).
    """
    largest = 0.0
    for j in numba.prange(len(mean)):
        x, y, z = mean[j, 0] - then[j, 0], mean[j, 1] - then[j, 1], mean[j, 2] - then[j, 2]
        w = quaternion[j]
        norm = math.sqrt(float(w[0]) ** 2 + float(w[1]) ** 2 + float(w[2]) ** 2 + float(w[3]) ** 2)
        dot = abs(w[0] * then[j, 6] + w[1] * then[j, 7] + w[2] * then[j, 8] + w[3] * then[j, 9]) / norm
        angle = 4.0 * math.asin(min(1.0, math.sqrt(max(0.0, 0.5 * (1.0 - dot)))))
        grown = 0.0
        for a in range(3):
            grown = max(grown, abs(log_scale[j, a] - then[j, 3 + a]))
        s_min, s_max = then[j, 10], then[j, 11]
        wider = s_max * (math.exp(grown) - 1.0) + angle * (s_max - s_min)
        distance = math.sqrt(x * x + y * y + z * z) + common_mm + cutoff_sigma * wider
        largest = max(largest, distance / math.sqrt(s_min * s_min + min_psf_mm2))
    return largest


@numba.njit(parallel=True, cache=True)
def remember(mean, log_scale, quaternion, then):
    """Centres, log-scales, unit quaternions, least and largest sigma [N, 12], to measure movement from."""
    for j in numba.prange(len(mean)):
        w = quaternion[j]
        norm = math.sqrt(float(w[0]) ** 2 + float(w[1]) ** 2 + float(w[2]) ** 2 + float(w[3]) ** 2)
        for a in range(3):
            then[j, a] = mean[j, a]
            then[j, 3 + a] = log_scale[j, a]
        for a in range(4):
            then[j, 6 + a] = w[a] / norm
        then[j, 10] = math.exp(min(log_scale[j, 0], log_scale[j, 1], log_scale[j, 2]))
        then[j, 11] = math.exp(max(log_scale[j, 0], log_scale[j, 1], log_scale[j, 2]))
