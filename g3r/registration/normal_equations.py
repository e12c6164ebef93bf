"""Normal equations of rigid slice-to-volume registration, all slices at once, through the PSF.

For a slice in pose (R, t) with gain g the model of a pixel at u is g sum_q w_q V(R (u + u_q) + t), with the
quadrature nodes u_q of the PSF (G3R Eq. 2). Parameters of a slice are a body-frame rotation w (R <- R exp[w]),
a body-frame translation v (t <- t + R v) and the logarithm of the gain; with the gradient h = R^T grad V the
derivatives are u x h, h and the model itself. Residuals count with a Cauchy loss of one width for all slices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid
from g3r.registration.similarity import correlation

N_PARAMETERS = 7


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations and statistics of the fit, slice by slice.

    Args:
        hessian: [K, 7, 7].
        gradient: [K, 7] right-hand side.
        loss: [K] mean Cauchy loss.
        moments: [K, 6] sums n, y, m, yy, mm, ym over the pixels y of a slice and the model m.
    """

    hessian: NDArray[np.float64]
    gradient: NDArray[np.float64]
    loss: NDArray[np.float64]
    moments: NDArray[np.float64]

    @property
    def ncc(self) -> NDArray[np.float64]:
        """Correlation of each slice with its model [K]; 0 where it is undefined."""
        return correlation(self.moments)


class SliceModel:
    """Data that stay the same while poses change: pixels, PSF nodes, the volume.

    Args:
        slices: K slices.
        volume: [I, J, K] on the grid.
        grid: voxel grid.
        stride: every n-th masked pixel is used (coarse levels).
        psf_points: quadrature nodes through the slice.
    """

    def __init__(
        self, slices: Slices, volume: NDArray[np.float32], grid: VolumeGrid, *, stride: int = 1, psf_points: int = 5
    ) -> None:
        index = slices.pixel_index[::stride]
        self.operator = VoxelOperator(slices.planes, grid, index, (1, 1, psf_points))
        self.value = slices.value[index]
        self.volume = np.ascontiguousarray(volume, dtype=np.float32)
        self.start = np.searchsorted(self.operator.plane, np.arange(len(slices) + 1))

    def evaluate(self, planes: Planes, gain: NDArray[np.float64], width: float) -> NormalEquations:
        """Linearise at poses and gains.

        Args:
            planes: the slices' pixel grids in their present poses.
            gain: [K] intensity factors.
            width: residual at which the Cauchy loss bends.
        """
        self.operator.move(planes)
        n = len(planes)
        hessian, gradient = np.zeros((n, N_PARAMETERS, N_PARAMETERS)), np.zeros((n, N_PARAMETERS))
        loss, moments = np.zeros(n), np.zeros((n, 6))
        op = self.operator
        _accumulate(
            self.volume,
            self.start,
            op.uv_mm,
            self.value,
            op.index_from_plane,
            op.index_center,
            op.node_index,
            op.node_mm,
            op.node_weight,
            gain,
            width,
            hessian,
            gradient,
            loss,
            moments,
        )
        return NormalEquations(hessian, gradient, loss, moments)

    def residuals(self, planes: Planes, gain: NDArray[np.float64]) -> NDArray[np.float32]:
        """Slice minus model for every used pixel."""
        self.operator.move(planes)
        model = gain[self.operator.plane] * self.operator.forward(self.volume)
        return self.value - model.astype(np.float32)


@numba.njit(parallel=True, cache=True)
def _accumulate(
    volume,
    start,
    uv,
    value,
    index_from_plane,
    index_center,
    node_index,
    node_mm,
    node_weight,
    gain,
    width,
    hessian,
    gradient,
    loss,
    moments,
):
    n_i, n_j, n_k = volume.shape
    for k in numba.prange(len(start) - 1):
        m = index_from_plane[k]
        jac = np.zeros(N_PARAMETERS)
        total = 0.0
        for p in range(start[k], start[k + 1]):
            x0 = index_center[k, 0] + m[0, 0] * uv[p, 0] + m[0, 1] * uv[p, 1]
            y0 = index_center[k, 1] + m[1, 0] * uv[p, 0] + m[1, 1] * uv[p, 1]
            z0 = index_center[k, 2] + m[2, 0] * uv[p, 0] + m[2, 1] * uv[p, 1]
            model = 0.0
            jac[:] = 0.0
            for q in range(len(node_weight)):
                x, y, z = x0 + node_index[k, q, 0], y0 + node_index[k, q, 1], z0 + node_index[k, q, 2]
                i, j, h = math.floor(x), math.floor(y), math.floor(z)
                if i < 0 or j < 0 or h < 0 or i + 1 >= n_i or j + 1 >= n_j or h + 1 >= n_k:
                    continue
                fx, fy, fz = x - i, y - j, z - h
                a000, a001 = volume[i, j, h], volume[i, j, h + 1]
                a010, a011 = volume[i, j + 1, h], volume[i, j + 1, h + 1]
                a100, a101 = volume[i + 1, j, h], volume[i + 1, j, h + 1]
                a110, a111 = volume[i + 1, j + 1, h], volume[i + 1, j + 1, h + 1]
                b00, b01 = a000 + fz * (a001 - a000), a010 + fz * (a011 - a010)
                b10, b11 = a100 + fz * (a101 - a100), a110 + fz * (a111 - a110)
                c0, c1 = b00 + fy * (b01 - b00), b10 + fy * (b11 - b10)
                gx = c1 - c0
                gy = (1.0 - fx) * (b01 - b00) + fx * (b11 - b10)
                gz = (1.0 - fx) * ((1.0 - fy) * (a001 - a000) + fy * (a011 - a010)) + fx * (
                    (1.0 - fy) * (a101 - a100) + fy * (a111 - a110)
                )
                w = node_weight[q]
                model += w * (c0 + fx * gx)
                hx = w * (m[0, 0] * gx + m[1, 0] * gy + m[2, 0] * gz)
                hy = w * (m[0, 1] * gx + m[1, 1] * gy + m[2, 1] * gz)
                hz = w * (m[0, 2] * gx + m[1, 2] * gy + m[2, 2] * gz)
                u, v, s = uv[p, 0] + node_mm[k, q, 0], uv[p, 1] + node_mm[k, q, 1], node_mm[k, q, 2]
                jac[0] += v * hz - s * hy
                jac[1] += s * hx - u * hz
                jac[2] += u * hy - v * hx
                jac[3] += hx
                jac[4] += hy
                jac[5] += hz
            jac[6] = model
            observed = value[p]
            residual = observed - gain[k] * model
            ratio = residual / width
            factor = 1.0 / (1.0 + ratio * ratio)
            total += math.log1p(ratio * ratio)
            for a in range(N_PARAMETERS):
                da = gain[k] * jac[a]
                gradient[k, a] += factor * da * residual
                for b in range(a, N_PARAMETERS):
                    hessian[k, a, b] += factor * da * gain[k] * jac[b]
            moments[k, 0] += 1.0
            moments[k, 1] += observed
            moments[k, 2] += model
            moments[k, 3] += observed * observed
            moments[k, 4] += model * model
            moments[k, 5] += observed * model
        for a in range(N_PARAMETERS):
            for b in range(a):
                hessian[k, a, b] = hessian[k, b, a]
        n_used = start[k + 1] - start[k]
        loss[k] = total / n_used if n_used > 0 else 0.0
