"""Numba kernels of the renderer's gradients: moments to parameters, and covariance to scales and turns."""

from __future__ import annotations

import math

import numba
import numpy as np

from g3r.gaussians.kernels import conditional, observe, quaternion_matrix, sweep_bounds, sweep_moments


@numba.njit(parallel=True, cache=True, fastmath=True)
def backward(
    mean, cov, log_volume, peak, rotation, center, gain, psf, shape, spacing, offset, start, order, cut,
    exact, n_workers, weight, buffers, plane_gradient,
):  # fmt: skip
    """Gradients of sum(weight * pixels) by the moments G0, G1, G2 of each pair.

    buffers [n_workers, N, 11] and plane_gradient [K, 7] are added to; columns as in `kernels`.
    """
    n_planes = len(rotation)
    for worker in numba.prange(n_workers):
        for k in range(worker, n_planes, n_workers):
            n_x, n_y = shape[k, 0], shape[k, 1]
            sx, sy = spacing[k, 0], spacing[k, 1]
            r = rotation[k]
            for pair in range(start[k], start[k + 1]):
                j = order[pair]
                mx, my, mz, sxx, sxy, sxz, syy, syz, szz = observe(mean, cov, j, r, center[k], psf[k])
                ez, cx, cy, cxx, cxy, cyy, det = conditional(mx, my, mz, sxx, sxy, sxz, syy, syz, szz)
                c2 = cut + 2.0 * ez
                if c2 <= 0.0 or not det > 0.0:
                    continue
                # with the gain in the weight, gradients below are those of the gained image
                unit = gain[k] * math.exp(ez)
                if exact:
                    unit *= math.exp(log_volume[j]) / math.sqrt(det * szz)
                px, py, x0, x1 = sweep_bounds(c2, cx, cy, cyy, n_x, n_y, sx, sy, cxx)
                m0, m1, m2, m3, m4, m5 = sweep_moments(
                    weight, offset[k], n_y, x0, x1, px, py, c2, cxx, cxy, cyy, det, sx, sy
                )
                # from moments about the centre on the plane to those of d = u - m, times B and the gain
                ax, ay, dz = cx - mx, cy - my, -mz
                g0 = unit * m0
                g1x, g1y, g1z = unit * (m1 + m0 * ax), unit * (m2 + m0 * ay), g0 * dz
                gxx = unit * (m3 + 2.0 * m1 * ax + m0 * ax * ax)
                gxy = unit * (m4 + m1 * ay + m2 * ax + m0 * ax * ay)
                gyy = unit * (m5 + 2.0 * m2 * ay + m0 * ay * ay)
                gxz, gyz, gzz = g1x * dz, g1y * dz, g0 * dz * dz
                i_det = 1.0 / (det * szz)
                pxx, pxy = (syy * szz - syz * syz) * i_det, (sxz * syz - sxy * szz) * i_det
                pxz, pyy = (sxy * syz - sxz * syy) * i_det, (sxx * szz - sxz * sxz) * i_det
                pyz, pzz = (sxy * sxz - sxx * syz) * i_det, (sxx * syy - sxy * sxy) * i_det
                c = peak[j]
                # dL/dm = c B P G1
                dmx = c * (pxx * g1x + pxy * g1y + pxz * g1z)
                dmy = c * (pxy * g1x + pyy * g1y + pyz * g1z)
                dmz = c * (pxz * g1x + pyz * g1y + pzz * g1z)
                # dL/dS = c B (P G2 P - G0 P) / 2; the second term comes from the amplitude factor alone
                a0, a1 = pxx * gxx + pxy * gxy + pxz * gxz, pxx * gxy + pxy * gyy + pxz * gyz
                a2 = pxx * gxz + pxy * gyz + pxz * gzz
                b0, b1 = pxy * gxx + pyy * gxy + pyz * gxz, pxy * gxy + pyy * gyy + pyz * gyz
                b2 = pxy * gxz + pyy * gyz + pyz * gzz
                e0, e1 = pxz * gxx + pyz * gxy + pzz * gxz, pxz * gxy + pyz * gyy + pzz * gyz
                e2 = pxz * gxz + pyz * gyz + pzz * gzz
                n0 = g0 if exact else 0.0
                h = 0.5 * c
                txx = h * (a0 * pxx + a1 * pxy + a2 * pxz - n0 * pxx)
                txy = h * (a0 * pxy + a1 * pyy + a2 * pyz - n0 * pxy)
                txz = h * (a0 * pxz + a1 * pyz + a2 * pzz - n0 * pxz)
                tyy = h * (b0 * pxy + b1 * pyy + b2 * pyz - n0 * pyy)
                tyz = h * (b0 * pxz + b1 * pyz + b2 * pzz - n0 * pyz)
                tzz = h * (e0 * pxz + e1 * pyz + e2 * pzz - n0 * pzz)
                wx = r[0, 0] * dmx + r[0, 1] * dmy + r[0, 2] * dmz
                wy = r[1, 0] * dmx + r[1, 1] * dmy + r[1, 2] * dmz
                wz = r[2, 0] * dmx + r[2, 1] * dmy + r[2, 2] * dmz
                out = buffers[worker, j]
                out[0] += g0
                out[1] += wx
                out[2] += wy
                out[3] += wz
                # R T R^T
                n = 4
                for a in range(3):
                    q0 = r[a, 0] * txx + r[a, 1] * txy + r[a, 2] * txz
                    q1 = r[a, 0] * txy + r[a, 1] * tyy + r[a, 2] * tyz
                    q2 = r[a, 0] * txz + r[a, 1] * tyz + r[a, 2] * tzz
                    for b in range(a, 3):
                        out[n] += q0 * r[b, 0] + q1 * r[b, 1] + q2 * r[b, 2]
                        n += 1
                out[10] += c * n0
                # planes: body-frame turn dL/dw = dL/dm x m + 2 (A_23, A_31, A_12), A = T S' - S' T
                ux, uy, uz = sxx - psf[k, 0], syy - psf[k, 1], szz - psf[k, 2]
                a12 = txx * sxy + txy * uy + txz * syz - (ux * txy + sxy * tyy + sxz * tyz)
                a13 = txx * sxz + txy * syz + txz * uz - (ux * txz + sxy * tyz + sxz * tzz)
                a23 = txy * sxz + tyy * syz + tyz * uz - (sxy * txz + uy * tyz + syz * tzz)
                plane = plane_gradient[k]
                plane[0] += dmy * mz - dmz * my + 2.0 * a23
                plane[1] += dmz * mx - dmx * mz - 2.0 * a13
                plane[2] += dmx * my - dmy * mx + 2.0 * a12
                plane[3] -= wx
                plane[4] -= wy
                plane[5] -= wz
                plane[6] += c * g0


@numba.njit(cache=True)
def _shape_gradient(j, log_scale, quaternion, buffers, peak_grad, mean_grad, scale_grad, quaternion_grad):
    n_workers = len(buffers)
    g = buffers[0, j].copy()
    for worker in range(1, n_workers):
        g += buffers[worker, j]
    peak_grad[j] = g[0]
    mean_grad[j, 0], mean_grad[j, 1], mean_grad[j, 2] = g[1], g[2], g[3]
    t = ((g[4], g[5], g[6]), (g[5], g[7], g[8]), (g[6], g[8], g[9]))
    r = quaternion_matrix(quaternion, j)
    rows = np.zeros((3, 3))
    for a in range(3):
        s = math.exp(log_scale[j, a])
        total = 0.0
        for i in range(3):
            dm = 2.0 * (t[i][0] * r[0][a] + t[i][1] * r[1][a] + t[i][2] * r[2][a]) * s
            total += dm * r[i][a] * s
            rows[i, a] = dm * s
        scale_grad[j, a] = total + g[10]
    w, x, y, z = (
        float(quaternion[j, 0]), float(quaternion[j, 1]), float(quaternion[j, 2]), float(quaternion[j, 3]),
    )  # fmt: skip
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    dw = 2 * (z * (rows[1, 0] - rows[0, 1]) + y * (rows[0, 2] - rows[2, 0]) + x * (rows[2, 1] - rows[1, 2]))
    dx = 2 * (
        y * (rows[0, 1] + rows[1, 0]) + z * (rows[0, 2] + rows[2, 0]) + w * (rows[2, 1] - rows[1, 2])
        - 2 * x * (rows[1, 1] + rows[2, 2])
    )  # fmt: skip
    dy = 2 * (
        x * (rows[0, 1] + rows[1, 0]) + z * (rows[1, 2] + rows[2, 1]) + w * (rows[0, 2] - rows[2, 0])
        - 2 * y * (rows[0, 0] + rows[2, 2])
    )  # fmt: skip
    dz = 2 * (
        x * (rows[0, 2] + rows[2, 0]) + y * (rows[1, 2] + rows[2, 1]) + w * (rows[1, 0] - rows[0, 1])
        - 2 * z * (rows[0, 0] + rows[1, 1])
    )  # fmt: skip
    along = w * dw + x * dx + y * dy + z * dz
    quaternion_grad[j, 0] = (dw - along * w) / length
    quaternion_grad[j, 1] = (dx - along * x) / length
    quaternion_grad[j, 2] = (dy - along * y) / length
    quaternion_grad[j, 3] = (dz - along * z) / length


@numba.njit(parallel=True, cache=True)
def shape_gradients(log_scale, quaternion, buffers, peak_grad, mean_grad, scale_grad, quaternion_grad):
    """Sum the workers' buffers and turn dL/dSigma into gradients of log-scales and quaternions.

    Sigma = M M^T with M = R diag(s): dL/dM = 2 T M, dL/dln s_a = sum_i dM_ia M_ia (+ the log-volume's),
    dL/dR = dM diag(s); the quaternion's gradient is projected off its own direction by the normalisation.
    """
    for j in numba.prange(len(log_scale)):
        _shape_gradient(j, log_scale, quaternion, buffers, peak_grad, mean_grad, scale_grad, quaternion_grad)
