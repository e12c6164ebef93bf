"""Numba kernels of the renderer's backward pass: pixel gradients to those of Gaussians, poses and gains.

`backward` is the pass over all planes. With w = dL/dy and g the projected Gaussian, six moments over its ellipse
(sums of w g, w g d, w g d d^T) give every gradient; see docs/method.md, "Gaussians". `shape_gradients` then takes
dL/dSigma to log-scales and quaternions. Arguments as in `kernels`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from g3r.gaussians.kernels import LOOSE, load, observe, project, quaternion_matrix, strip_at, strip_columns
from g3r.gaussians.simd import N_LANES, strip_moments

f32 = np.float32


@numba.njit(forceinline=True, fastmath=LOOSE)
def pair_moments(record, cut, n_x, n_y, image):
    """Moments (in pixels) of image times exp(e) about the Gaussian's centre on the plane."""
    pitch = n_y + N_LANES
    limit = f32(-0.5 * cut)
    m0 = m1 = m2 = m3 = m4 = m5 = f32(0.0)
    start, stop = strip_columns(record, n_y)
    for column in range(start, stop + 1, N_LANES):
        first, n_rows, dx, dy = strip_at(record, cut, column, stop, n_x, pitch)
        a0, a1, a2, a3, a4, a5 = strip_moments(
            image, first, pitch, n_rows, record.e_0, record.q_x, record.q_u, record.slope, dx, dy, limit, dy
        )
        m0, m1, m2, m3, m4, m5 = m0 + a0, m1 + a1, m2 + a2, m3 + a3, m4 + a4, m5 + a5
    return m0, m1, m2, m3, m4, m5


@numba.njit(forceinline=True, fastmath=LOOSE)
def gather(projections, n, cloud, planes, k, cut, exact, image, buffer, plane, with_pose):
    """Gradients of sum(image * pixels of plane k), added to those of its Gaussians and of the plane.

    image holds dL/dy in padded rows, buffer [N, 11] and plane [7] the gradients (columns as in `kernels`).
    The chain goes through the 2D Gaussian of centre m_xy - k m_z and covariance C = S_xy - k k^T S_zz with
    k = S_xy,z / S_zz; for the exact amplitude ln B has -ln|S| / 2 = -(ln|C| + ln S_zz) / 2.
    """
    r, t, psf = planes.rotation[k], planes.center[k], planes.psf[k]
    n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
    sx, sy = planes.spacing[k, 0], planes.spacing[k, 1]
    p0 = p1 = p2 = p3 = p4 = p5 = p6 = 0.0
    for i in range(n):
        record = projections[i]
        m0, m1, m2, m3, m4, m5 = pair_moments(record, cut, n_x, n_y, image)
        j = record.gaussian
        mx, my, mz, sxx, sxy, sxz, syy, syz, szz = observe(cloud.shapes, j, r, t, psf)
        iz = 1.0 / szz
        kx, ky = sxz * iz, syz * iz
        cxx, cxy, cyy = sxx - kx * sxz, sxy - kx * syz, syy - ky * syz
        over_det = 1.0 / (cxx * cyy - cxy * cxy)
        ixx, ixy, iyy = cyy * over_det, -cxy * over_det, cxx * over_det
        g0 = float(record.unit) * m0
        height = float(record.unit) * cloud.amplitude[j]
        whole = height * m0
        attenuation = whole if exact else 0.0
        # dL/dcentre = C^-1 M1, dL/dC = (C^-1 M2 C^-1 - M0 C^-1) / 2
        hx, hy = height * sx, height * sy
        gx, gy = hx * m1, hy * m2
        gxx, gxy, gyy = hx * sx * m3, hx * sy * m4, hy * sy * m5
        dx, dy = ixx * gx + ixy * gy, ixy * gx + iyy * gy
        axx, axy = ixx * gxx + ixy * gxy, ixx * gxy + ixy * gyy
        ayx, ayy = ixy * gxx + iyy * gxy, ixy * gxy + iyy * gyy
        txx = 0.5 * (axx * ixx + axy * ixy - attenuation * ixx)
        txy = 0.5 * (axx * ixy + axy * iyy - attenuation * ixy)
        tyy = 0.5 * (ayx * ixy + ayy * iyy - attenuation * iyy)
        # back through k, to S and m
        wx, wy = txx * kx + txy * ky, txy * kx + tyy * ky
        dkx, dky = -mz * dx - 2.0 * szz * wx, -mz * dy - 2.0 * szz * wy
        dz = -(kx * dx + ky * dy) - whole * mz * iz
        txz, tyz = 0.5 * dkx * iz, 0.5 * dky * iz
        tzz = 0.5 * iz * (whole * mz * mz * iz - attenuation) - (wx * kx + wy * ky) - (dkx * kx + dky * ky) * iz
        world_x = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
        world_y = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
        world_z = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
        out = buffer[j]
        out[0] += g0
        out[1] += world_x
        out[2] += world_y
        out[3] += world_z
        # dL/dSigma = R T R^T
        q0 = r[0, 0] * txx + r[0, 1] * txy + r[0, 2] * txz
        q1 = r[0, 0] * txy + r[0, 1] * tyy + r[0, 2] * tyz
        q2 = r[0, 0] * txz + r[0, 1] * tyz + r[0, 2] * tzz
        out[4] += q0 * r[0, 0] + q1 * r[0, 1] + q2 * r[0, 2]
        out[5] += q0 * r[1, 0] + q1 * r[1, 1] + q2 * r[1, 2]
        out[6] += q0 * r[2, 0] + q1 * r[2, 1] + q2 * r[2, 2]
        q0 = r[1, 0] * txx + r[1, 1] * txy + r[1, 2] * txz
        q1 = r[1, 0] * txy + r[1, 1] * tyy + r[1, 2] * tyz
        q2 = r[1, 0] * txz + r[1, 1] * tyz + r[1, 2] * tzz
        out[7] += q0 * r[1, 0] + q1 * r[1, 1] + q2 * r[1, 2]
        out[8] += q0 * r[2, 0] + q1 * r[2, 1] + q2 * r[2, 2]
        q0 = r[2, 0] * txx + r[2, 1] * txy + r[2, 2] * txz
        q1 = r[2, 0] * txy + r[2, 1] * tyy + r[2, 2] * tyz
        q2 = r[2, 0] * txz + r[2, 1] * tyz + r[2, 2] * tzz
        out[9] += q0 * r[2, 0] + q1 * r[2, 1] + q2 * r[2, 2]
        out[10] += attenuation
        if with_pose:
            # body-frame rotation dL/dw = dL/dm x m + 2 (A_23, A_31, A_12), A = T S' - S' T, S' = S - D
            ux, uy, uz = sxx - psf[0], syy - psf[1], szz - psf[2]
            a12 = txx * sxy + txy * uy + txz * syz - (ux * txy + sxy * tyy + sxz * tyz)
            a13 = txx * sxz + txy * syz + txz * uz - (ux * txz + sxy * tyz + sxz * tzz)
            a23 = txy * sxz + tyy * syz + tyz * uz - (sxy * txz + uy * tyz + syz * tzz)
            p0 += dy * mz - dz * my + 2.0 * a23
            p1 += dz * mx - dx * mz - 2.0 * a13
            p2 += dx * my - dy * mx + 2.0 * a12
            p3 -= world_x
            p4 -= world_y
            p5 -= world_z
        p6 += whole
    plane[0] += p0
    plane[1] += p1
    plane[2] += p2
    plane[3] += p3
    plane[4] += p4
    plane[5] += p5
    plane[6] += p6


@numba.njit(parallel=True, nogil=True, cache=True)
def backward(cloud, planes, overlaps, cut, exact, work, weight, buffers, plane_gradient):
    """The backward pass: gradients of sum(weight * pixels) by the moments of each projection.

    weight [P] is dL/dy; buffers [n_workers, N, 11] and plane_gradient [K, 7] are added to (columns as in `kernels`).
    """
    n_workers = len(work.images)
    for worker in numba.prange(n_workers):
        image, mine = work.images[worker], work.projections[worker]
        for k in range(worker, len(planes.rotation), n_workers):
            n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
            load(image, weight, planes.offset[k], n_x, n_y)
            n = project(cloud.shapes, planes, overlaps, k, cut, exact, mine)
            gather(mine, n, cloud, planes, k, cut, exact, image, buffers[worker], plane_gradient[k], True)


@numba.njit(forceinline=True)
def _quaternion_gradient(quaternion, j, rows, out):
    """Gradient by quaternion j of sum(rows * R), at right angles to the quaternion, since R normalises it."""
    w, x, y, z = (float(quaternion[j, 0]), float(quaternion[j, 1]), float(quaternion[j, 2]), float(quaternion[j, 3]))
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rows
    dw = 2 * (z * (r10 - r01) + y * (r02 - r20) + x * (r21 - r12))
    dx = 2 * (y * (r01 + r10) + z * (r02 + r20) + w * (r21 - r12) - 2 * x * (r11 + r22))
    dy = 2 * (x * (r01 + r10) + z * (r12 + r21) + w * (r02 - r20) - 2 * y * (r00 + r22))
    dz = 2 * (x * (r02 + r20) + y * (r12 + r21) + w * (r10 - r01) - 2 * z * (r00 + r11))
    along = w * dw + x * dx + y * dy + z * dz
    out[j, 0] = (dw - along * w) / length
    out[j, 1] = (dx - along * x) / length
    out[j, 2] = (dy - along * y) / length
    out[j, 3] = (dz - along * z) / length


@numba.njit
def _shape_gradient(j, log_scale, quaternion, buffers, mean_grad, scale_grad, quaternion_grad, amplitude_grad):
    for worker in range(1, len(buffers)):
        for column in range(buffers.shape[2]):
            buffers[0, j, column] += buffers[worker, j, column]
    g = buffers[0, j]
    amplitude_grad[j] = g[0]
    mean_grad[j, 0], mean_grad[j, 1], mean_grad[j, 2] = g[1], g[2], g[3]
    r = quaternion_matrix(quaternion, j)
    v0 = 2 * math.exp(2 * float(log_scale[j, 0]))
    v1 = 2 * math.exp(2 * float(log_scale[j, 1]))
    v2 = 2 * math.exp(2 * float(log_scale[j, 2]))
    # rows = 2 T R diag(s^2)
    t0, t1, t2 = (g[4], g[5], g[6]), (g[5], g[7], g[8]), (g[6], g[8], g[9])
    rows = (
        (_along(t0, r, 0) * v0, _along(t0, r, 1) * v1, _along(t0, r, 2) * v2),
        (_along(t1, r, 0) * v0, _along(t1, r, 1) * v1, _along(t1, r, 2) * v2),
        (_along(t2, r, 0) * v0, _along(t2, r, 1) * v1, _along(t2, r, 2) * v2),
    )
    for a in range(3):
        scale_grad[j, a] = rows[0][a] * r[0][a] + rows[1][a] * r[1][a] + rows[2][a] * r[2][a] + g[10]
    _quaternion_gradient(quaternion, j, rows, quaternion_grad)


@numba.njit(forceinline=True)
def _along(t, r, a):
    """Product of a row with column a of a rotation."""
    return t[0] * r[0][a] + t[1] * r[1][a] + t[2] * r[2][a]


@numba.njit(parallel=True, nogil=True, cache=True)
def shape_gradients(log_scale, quaternion, buffers, mean_grad, scale_grad, quaternion_grad, amplitude_grad):
    """Sum the workers' buffers (into the first) and take dL/dSigma to log-scales and quaternions.

    Sigma = M M^T with M = R diag(s): dL/dM = 2 T M, dL/dln s_a = sum_i dM_ia M_ia (+ the log-volume's),
    dL/dR = dM diag(s).

    Args:
        log_scale: [N, 3].
        quaternion: [N, 4].
        buffers: [n_workers, N, 11], columns as in `kernels`.
        mean_grad: [N, 3], written.
        scale_grad: [N, 3], written.
        quaternion_grad: [N, 4], written.
        amplitude_grad: [N], written.
    """
    for j in numba.prange(len(log_scale)):
        _shape_gradient(j, log_scale, quaternion, buffers, mean_grad, scale_grad, quaternion_grad, amplitude_grad)
