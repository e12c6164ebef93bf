"""Numba kernels of the fit: L1 loss of planes with all its gradients in one pass, penalty, Adam, movement."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.gaussians.kernels import clear, project, rasterise
from g3r.gaussians.kernels_backward import gather
from g3r.gaussians.simd import N_LANES

f32 = np.float32

SUMS = {"contract", "arcp", "nsz", "reassoc"}
"""Fast-math flags: sums over a row in any order, so that they are vectorised; NaN is preserved."""


class PixelArrays(NamedTuple):
    """Pixels of the planes of a term, read from each plane's offset on.

    Attributes:
        value: [P].
        weight: [P] not negative.
        basis: [5, P] terms of the log-intensity fields; [5, 0] without fields.
    """

    value: NDArray[np.float32]
    weight: NDArray[np.float32]
    basis: NDArray[np.float32]


class AdamRate(NamedTuple):
    """Numbers of one step of Adam.

    Attributes:
        step: step size.
        beta_1: decay of the mean of gradients.
        beta_2: decay of the mean of their squares.
        correction: 1 - beta_1^t.
        root_correction: sqrt(1 - beta_2^t).
    """

    step: float
    beta_1: float
    beta_2: float
    correction: float
    root_correction: float


@numba.njit(fastmath=SUMS)
def _row(image, row, pixels, begin, n, factor):
    """Weighted absolute residual of a row of pixels; overwrites the pixels with its gradient."""
    target, weight = pixels.value, pixels.weight
    total = f32(0.0)
    for y in range(n):
        residual = image[row + y] - target[begin + y]
        w = weight[begin + y]
        total += w * abs(residual)
        sign = f32(1.0) if residual > f32(0.0) else f32(-1.0) if residual < f32(0.0) else f32(0.0)
        image[row + y] = factor * w * sign
    return total


@numba.njit(fastmath=SUMS)
def _row_under_field(image, row, pixels, begin, n, factor, c, slopes):
    """As `_row`, with the pixels under a bias field exp(sum_n c_n basis_n); adds dL/dc to `slopes`."""
    target, weight, basis = pixels.value, pixels.weight, pixels.basis
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


@numba.njit(parallel=True, nogil=True, cache=True)
def image_l1(
    cloud,
    planes,
    chosen,
    overlaps,
    cut,
    work,
    pixels,
    slice_weight,
    coefficients,
    factor,
    with_pose,
    buffers,
    plane_gradient,
    field_gradient,
    residual,
):
    """L1 of rendered planes and its gradients: each plane is rendered, compared and differentiated in turn.

    The loss is factor sum_k slice_weight_k residual_k over the chosen planes, with residual_k the sum of weight
    |pixel - target| over plane k.

    Args:
        cloud: `CloudArrays`.
        planes: `PlaneArrays`.
        chosen: [M] numbers of the planes in use.
        overlaps: `OverlapArrays`.
        cut: square of the cut-off in sigma.
        work: `Workspace`.
        pixels: `PixelArrays`.
        slice_weight: [K].
        coefficients: [K, 5] of the planes' fields.
        factor: of the loss.
        with_pose: whether gradients of poses are wanted.
        buffers: [n_workers, N, 11], gradients of the Gaussians are added.
        plane_gradient: [K, 7], written for the chosen planes, columns as in `gaussians.kernels`.
        field_gradient: [K, 5], written for the chosen planes.
        residual: [K], written for the chosen planes.
    """
    n_workers = len(work.images)
    for worker in numba.prange(n_workers):
        image, mine = work.images[worker], work.projections[worker]
        for place in range(worker, len(chosen), n_workers):
            k = chosen[place]
            n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
            pitch = n_y + N_LANES
            clear(image, n_x, n_y)
            n = project(cloud.shapes, planes, overlaps, k, cut, True, mine)
            rasterise(mine, n, cloud.amplitude, cut, n_x, n_y, image)
            total, scale = 0.0, f32(factor * slice_weight[k])
            slopes = field_gradient[k]
            slopes[:] = 0.0
            for x in range(n_x):
                row, begin = x * pitch, planes.offset[k] + x * n_y
                if pixels.basis.shape[1]:
                    total += _row_under_field(image, row, pixels, begin, n_y, scale, coefficients[k], slopes)
                else:
                    total += _row(image, row, pixels, begin, n_y, scale)
                image[row + n_y : row + pitch] = f32(0.0)
            image[n_x * pitch : n_x * pitch + N_LANES] = f32(0.0)
            residual[k] = total
            plane_gradient[k] = 0.0
            if scale != f32(0.0):
                gather(mine, n, cloud, planes, k, cut, True, image, buffers[worker], plane_gradient[k], with_pose)


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=SUMS)
def scale_penalty(log_scale, seed, factor, gradient):
    """Scale regulariser: sum of (log_scale - seed)^2 over [N, 3].

    Args:
        log_scale: [N, 3].
        seed: [N, 3] log-scales where the fit began.
        factor: of the gradient.
        gradient: [N, 3], factor times the gradient is added.
    """
    total = 0.0
    for j in numba.prange(len(log_scale)):
        for a in range(3):
            away = log_scale[j, a] - seed[j, a]
            gradient[j, a] += f32(2.0 * factor) * away
            total += away * away
    return total


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=SUMS)
def adam(values, gradient, first, second, rate):
    """One step of Adam; returns how many gradients are not finite.

    Args:
        values: [n] parameters, changed.
        gradient: [n].
        first: [n] mean of gradients, changed.
        second: [n] mean of their squares, changed.
        rate: `AdamRate`.

    Source: Kingma and Ba 2015, Algorithm 1.
    """
    step, beta_1, beta_2, correction, root_correction = rate
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


@numba.njit(parallel=True, nogil=True, cache=True)
def farthest_move(mean, log_scale, quaternion, then, cutoff_sigma, common_mm, min_psf_mm2):
    """Bound of the change of any Gaussian's distance from a plane less its reach there, in units of its sigma.

    With n a unit vector, the distance along n changes by at most |mean - then| + common_mm, and
    sigma_n = sqrt(n^T Sigma n + D) by at most max|s - s_then| + angle (s_max - s_min), the largest slope of |S n|
    on the unit sphere. sigma_n is at least sqrt(s_min^2 + min_psf_mm2).

    Args:
        mean: [N, 3] mm.
        log_scale: [N, 3].
        quaternion: [N, 4].
        then: [N, 12] of `remember`.
        cutoff_sigma: where a Gaussian ends.
        common_mm: largest movement of a plane.
        min_psf_mm2: least variance of the PSF in any direction.
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


@numba.njit(parallel=True, nogil=True, cache=True)
def remember(mean, log_scale, quaternion, then):
    """Write the state that `farthest_move` compares with.

    Args:
        mean: [N, 3] mm.
        log_scale: [N, 3].
        quaternion: [N, 4].
        then: [N, 12], written: centres, log-scales, unit quaternions, least and largest sigma.
    """
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
