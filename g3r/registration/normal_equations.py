"""Normal equations of rigid slice-to-volume registration, all slices at once, through the PSF.

For a slice in pose (R, t) with gain g the model of a pixel at u is g sum_q w_q V(R (u + u_q) + t), with the
PSF's quadrature nodes u_q. Parameters of a slice are a body-frame turn w (R <- R exp[w]), a body-frame shift
v (t <- t + R v) and the logarithm of the gain; with the gradient h = R^T grad V the derivatives are
u x h, h and the model itself. Residuals count with the Cauchy loss of a common width.
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

N_PARAMETERS = 7


@dataclass(frozen=True)
class NormalEquations:
    """Per slice: hessian [K, 7, 7] and right-hand side [K, 7], and statistics of the fit.

    loss [K] is the mean Cauchy loss; ncc [K] the normalised cross-correlation of slice and model;
    moments [K, 6] the sums n, y, m, yy, mm, ym from which it comes.
    """

    hessian: NDArray[np.float64]
    gradient: NDArray[np.float64]
    loss: NDArray[np.float64]
    moments: NDArray[np.float64]

    @property
    def ncc(self) -> NDArray[np.float64]:
        """Correlation of each slice with its model [K]; 0 where it is undefined."""
        return correlation(self.moments)


def correlation(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation coefficients from sums n, y, m, yy, mm, ym [..., 6]; 0 where a variance vanishes."""
    n, y, m, yy, mm, ym = np.moveaxis(moments, -1, 0)
    n = np.maximum(n, 1.0)
    var_y, var_m = yy - y * y / n, mm - m * m / n
    product = var_y * var_m
    defined = (var_y > 1e-12 * yy) & (var_m > 1e-12 * mm) & (product > 0)
    return np.where(defined, (ym - y * m / n) / np.sqrt(np.where(defined, product, 1.0)), 0.0)


class SliceModel:
    """Everything that stays the same while poses change: pixels, PSF nodes, the volume.

    Args:
        slices: K slices.
        volume: [I, J, K] on the grid.
        grid: voxel grid.
        stride: use every n-th masked pixel (coarse levels).
        psf_points: quadrature nodes through the slice.
        weight: [P'] of every masked pixel, before the stride.
    """

    def __init__(
        self,
        slices: Slices,
        volume: NDArray[np.float32],
        grid: VolumeGrid,
        *,
        stride: int = 1,
        psf_points: int = 5,
        weight: NDArray[np.float32] | None = None,
    ) -> None:
        index = slices.pixel_index[::stride]
        self.operator = VoxelOperator(slices.planes, grid, index, (1, 1, psf_points))
        self.value = slices.value[index]
        self.weight = np.ones(len(index), np.float32) if weight is None else weight[::stride]
        self.volume = np.ascontiguousarray(volume, dtype=np.float32)
        self.start = np.searchsorted(self.operator.plane, np.arange(len(slices) + 1))

    def evaluate(self, planes: Planes, gain: NDArray[np.float64], width: float) -> NormalEquations:
        """Linearise at poses and gains; `width` is the residual at which the Cauchy loss bends."""
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
            self.weight,
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
        """Slice minus model for every pixel in use."""
        self.operator.move(planes)
        model = gain[self.operator.plane] * self.operator.forward(self.volume)
        return self.value - model.astype(np.float32)


@numba.njit(parallel=True, cache=True)
def _accumulate(
    volume,
    start,
    uv,
    value,
    weight,
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
        n_used = 0.0
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
            slice_weight = weight[p]
            factor = slice_weight / (1.0 + ratio * ratio)
            total += slice_weight * math.log1p(ratio * ratio)
            n_used += slice_weight
            for a in range(N_PARAMETERS):
                da = gain[k] * jac[a]
                gradient[k, a] += factor * da * residual
                for b in range(a, N_PARAMETERS):
                    hessian[k, a, b] += factor * da * gain[k] * jac[b]
            moments[k, 0] += slice_weight
            moments[k, 1] += slice_weight * observed
            moments[k, 2] += slice_weight * model
            moments[k, 3] += slice_weight * observed * observed
            moments[k, 4] += slice_weight * model * model
            moments[k, 5] += slice_weight * observed * model
        for a in range(N_PARAMETERS):
            for b in range(a):
                hessian[k, a, b] = hessian[k, b, a]
        loss[k] = total / n_used if n_used > 0 else 0.0
