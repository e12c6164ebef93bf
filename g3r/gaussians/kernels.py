"""Numba kernels of the renderer: pair lists, forward, and backward by moments.

Mathematics and names as in docs/method.md, "The renderer". Set-up of a (Gaussian, plane) pair is float64 (a
nearly flat Gaussian has a condition number of 1e6, beyond float32); the sweep over its pixels is float32.
Each worker takes every n-th plane, so that the split of work, and with it the order of the sums, depends on
the number of workers alone.
"""

from __future__ import annotations

import math

import numba
import numpy as np

f32 = np.float32

# Gradient columns of a Gaussian in the buffers: peak, mean (3), covariance xx xy xz yy yz zz, log-volume.
N_GRADIENTS = 11
# Gradient columns of a plane: body-frame rotation (3), world translation (3), log-gain.
N_PLANE_GRADIENTS = 7


@numba.njit(inline="always", fastmath=True)
def fast_exp(e):
    """exp(e) for e in [-18, 0] within 2e-7 absolutely: a polynomial of e/16, squared four times."""
    t = e * f32(0.0625)
    p = f32(1.0) + t * (f32(1.0) + t * (f32(0.5) + t * (f32(1 / 6) + t * (f32(1 / 24) + t * f32(1 / 120)))))
    p = p * p
    p = p * p
    p = p * p
    return p * p


@numba.njit(inline="always")
def observe(mean, cov, j, r, t, psf):
    """Mean m and covariance S = R^T Sigma R + D of Gaussian j in the frame of a plane (r, t, psf)."""
    dx, dy, dz = mean[j, 0] - t[0], mean[j, 1] - t[1], mean[j, 2] - t[2]
    mx = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    my = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    mz = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
    a, b, c, d, e, f = cov[j, 0], cov[j, 1], cov[j, 2], cov[j, 3], cov[j, 4], cov[j, 5]
    u0 = a * r[0, 0] + b * r[1, 0] + c * r[2, 0]
    u1 = b * r[0, 0] + d * r[1, 0] + e * r[2, 0]
    u2 = c * r[0, 0] + e * r[1, 0] + f * r[2, 0]
    v0 = a * r[0, 1] + b * r[1, 1] + c * r[2, 1]
    v1 = b * r[0, 1] + d * r[1, 1] + e * r[2, 1]
    v2 = c * r[0, 1] + e * r[1, 1] + f * r[2, 1]
    w0 = a * r[0, 2] + b * r[1, 2] + c * r[2, 2]
    w1 = b * r[0, 2] + d * r[1, 2] + e * r[2, 2]
    w2 = c * r[0, 2] + e * r[1, 2] + f * r[2, 2]
    sxx = r[0, 0] * u0 + r[1, 0] * u1 + r[2, 0] * u2 + psf[0]
    sxy = r[0, 0] * v0 + r[1, 0] * v1 + r[2, 0] * v2
    sxz = r[0, 0] * w0 + r[1, 0] * w1 + r[2, 0] * w2
    syy = r[0, 1] * v0 + r[1, 1] * v1 + r[2, 1] * v2 + psf[1]
    syz = r[0, 1] * w0 + r[1, 1] * w1 + r[2, 1] * w2
    szz = r[0, 2] * w0 + r[1, 2] * w1 + r[2, 2] * w2 + psf[2]
    return mx, my, mz, sxx, sxy, sxz, syy, syz, szz


@numba.njit(inline="always")
def conditional(mx, my, mz, sxx, sxy, sxz, syy, syz, szz):
    """The 2D Gaussian that a 3D one leaves on its plane: exponent at its centre, centre, covariance, det."""
    iz = 1.0 / szz
    cx, cy = mx - sxz * iz * mz, my - syz * iz * mz
    cxx, cxy, cyy = sxx - sxz * sxz * iz, sxy - sxz * syz * iz, syy - syz * syz * iz
    return -0.5 * mz * mz * iz, cx, cy, cxx, cxy, cyy, cxx * cyy - cxy * cxy


@numba.njit(inline="always")
def sweep_bounds(c2, cx, cy, cyy, n_x, n_y, sx, sy, cxx):
    """Index of the centre and the range of x rows that the ellipse touches."""
    px, py = cx / sx + 0.5 * (n_x - 1), cy / sy + 0.5 * (n_y - 1)
    half = math.sqrt(c2 * cxx) / sx
    return px, py, max(0, math.ceil(px - half)), min(n_x - 1, math.floor(px + half))


@numba.njit(cache=True)
def pair_mask(mean, cov, r, t, psf, half_x, half_y, cut, chosen):
    """Number of Gaussians whose ellipsoid at the cut-off may touch a plane; their numbers into `chosen`."""
    n = 0
    for j in range(len(mean)):
        dx, dy, dz = mean[j, 0] - t[0], mean[j, 1] - t[1], mean[j, 2] - t[2]
        touches = True
        for axis in (2, 0, 1):
            x, y, z = r[0, axis], r[1, axis], r[2, axis]
            m = dx * x + dy * y + dz * z
            s = (
                cov[j, 0] * x * x + cov[j, 3] * y * y + cov[j, 5] * z * z
                + 2.0 * (cov[j, 1] * x * y + cov[j, 2] * x * z + cov[j, 4] * y * z) + psf[axis]
            )  # fmt: skip
            reach = abs(m) - (half_x if axis == 0 else half_y if axis == 1 else 0.0)
            if reach > 0.0 and reach * reach > cut * s:
                touches = False
                break
        if touches:
            chosen[n] = j
            n += 1
    return n


@numba.njit(parallel=True, cache=True)
def covariances(log_scale, quaternion, cov, log_volume):
    """Sigma (xx xy xz yy yz zz) and ln(s1 s2 s3) of every Gaussian, float64."""
    for j in numba.prange(len(log_scale)):
        r = quaternion_matrix(quaternion, j)
        s0, s1, s2 = math.exp(log_scale[j, 0]), math.exp(log_scale[j, 1]), math.exp(log_scale[j, 2])
        v0, v1, v2 = s0 * s0, s1 * s1, s2 * s2
        n = 0
        for a in range(3):
            for b in range(a, 3):
                cov[j, n] = r[a][0] * r[b][0] * v0 + r[a][1] * r[b][1] * v1 + r[a][2] * r[b][2] * v2
                n += 1
        log_volume[j] = log_scale[j, 0] + log_scale[j, 1] + log_scale[j, 2]


@numba.njit(inline="always")
def quaternion_matrix(quaternion, j):
    """Rotation (tuple of rows) of quaternion j, which is normalised first."""
    w, x, y, z = (
        float(quaternion[j, 0]), float(quaternion[j, 1]), float(quaternion[j, 2]), float(quaternion[j, 3]),
    )  # fmt: skip
    n = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@numba.njit(parallel=True, cache=True, fastmath=True)
def forward(
    mean, cov, log_volume, peak, rotation, center, gain, psf, shape, spacing, offset, start, order, cut,
    exact, n_workers, out,
):  # fmt: skip
    """Add every pair's Gaussian, gain included, onto the flat pixels `out`."""
    n_planes = len(rotation)
    for worker in numba.prange(n_workers):
        for k in range(worker, n_planes, n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            sx, sy = spacing[k, 0], spacing[k, 1]
            for pair in range(start[k], start[k + 1]):
                j = order[pair]
                mx, my, mz, sxx, sxy, sxz, syy, syz, szz = observe(
                    mean, cov, j, rotation[k], center[k], psf[k]
                )
                ez, cx, cy, cxx, cxy, cyy, det = conditional(mx, my, mz, sxx, sxy, sxz, syy, syz, szz)
                c2 = cut + 2.0 * ez
                if c2 <= 0.0 or not det > 0.0:
                    continue
                height = gain[k] * peak[j] * math.exp(ez)
                if exact:
                    height *= math.exp(log_volume[j]) / math.sqrt(det * szz)
                px, py, x0, x1 = sweep_bounds(c2, cx, cy, cyy, n_x, n_y, sx, sy, cxx)
                amplitude = f32(height)
                qx, qxy, qy = (
                    f32(-0.5 * cyy / det * sx * sx),
                    cxy / det * sx * sy,
                    f32(-0.5 * cxx / det * sy * sy),
                )
                slope, width = cxy / cxx * sx / sy, math.sqrt(det / cxx) / sy
                for x in range(x0, x1 + 1):
                    ddx = x - px
                    half = width * math.sqrt(max(c2 - ddx * ddx * sx * sx / cxx, 0.0))
                    middle = py + slope * ddx
                    y0, y1 = max(0, math.ceil(middle - half)), min(n_y - 1, math.floor(middle + half))
                    base, linear = qx * f32(ddx) * f32(ddx), f32(qxy * ddx)
                    row = offset[k] + x * n_y
                    first = f32(y0 - py)
                    for n in range(y1 - y0 + 1):
                        ddy = first + f32(n)
                        out[row + y0 + n] += amplitude * fast_exp(base + ddy * (linear + qy * ddy))


@numba.njit(inline="always")
def sweep_moments(weight, row0, n_y, x0, x1, px, py, c2, cxx, cxy, cyy, det, sx, sy):
    """Six moments (mm) of weight times the 2D Gaussian about the Gaussian's centre on the plane."""
    qx, qxy, qy = f32(-0.5 * cyy / det * sx * sx), cxy / det * sx * sy, f32(-0.5 * cxx / det * sy * sy)
    slope, width = cxy / cxx * sx / sy, math.sqrt(det / cxx) / sy
    m0 = m1 = m2 = m3 = m4 = m5 = 0.0
    for x in range(x0, x1 + 1):
        ddx = x - px
        half = width * math.sqrt(max(c2 - ddx * ddx * sx * sx / cxx, 0.0))
        middle = py + slope * ddx
        y0, y1 = max(0, math.ceil(middle - half)), min(n_y - 1, math.floor(middle + half))
        base, linear = qx * f32(ddx) * f32(ddx), f32(qxy * ddx)
        row = row0 + x * n_y
        first = f32(y0 - py)
        s0, s1, s2 = f32(0.0), f32(0.0), f32(0.0)
        for n in range(y1 - y0 + 1):
            ddy = first + f32(n)
            g = weight[row + y0 + n] * fast_exp(base + ddy * (linear + qy * ddy))
            s0 += g
            s1 += g * ddy
            s2 += g * ddy * ddy
        m0 += float(s0)
        m1 += ddx * s0
        m2 += float(s1)
        m3 += ddx * ddx * s0
        m4 += ddx * s1
        m5 += float(s2)
    return m0, m1 * sx, m2 * sy, m3 * sx * sx, m4 * sx * sy, m5 * sy * sy


@numba.njit(parallel=True, cache=True, fastmath=True)
def adjoint_peak(
    mean, cov, log_volume, rotation, center, gain, psf, shape, spacing, offset, start, order, cut, exact,
    n_workers, weight, buffers,
):  # fmt: skip
    """A^T w for y = A c: gradient of sum(w y) in the peaks alone, into buffers [n_workers, N]."""
    n_planes = len(rotation)
    for worker in numba.prange(n_workers):
        for k in range(worker, n_planes, n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            sx, sy = spacing[k, 0], spacing[k, 1]
            for pair in range(start[k], start[k + 1]):
                j = order[pair]
                mx, my, mz, sxx, sxy, sxz, syy, syz, szz = observe(
                    mean, cov, j, rotation[k], center[k], psf[k]
                )
                ez, cx, cy, cxx, cxy, cyy, det = conditional(mx, my, mz, sxx, sxy, sxz, syy, syz, szz)
                c2 = cut + 2.0 * ez
                if c2 <= 0.0 or not det > 0.0:
                    continue
                height = gain[k] * math.exp(ez)
                if exact:
                    height *= math.exp(log_volume[j]) / math.sqrt(det * szz)
                px, py, x0, x1 = sweep_bounds(c2, cx, cy, cyy, n_x, n_y, sx, sy, cxx)
                moments = sweep_moments(
                    weight, offset[k], n_y, x0, x1, px, py, c2, cxx, cxy, cyy, det, sx, sy
                )
                buffers[worker, j] += height * moments[0]
