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

from g3r.acquisition.kernels import REORDERED, RUN, locate
from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.thinning import thinned
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


class SampledSlices:
    """Data that stay the same while poses change: pixels, PSF nodes and the volume.

    Args:
        slices: K slices.
        volume: [I, J, K] on the grid.
        grid: voxel grid.
        n_pixels: at most so many masked pixels are used (coarse levels); all when None.
        psf_points: quadrature nodes through the slice.
    """

    def __init__(
        self,
        slices: Slices,
        volume: NDArray[np.float32],
        grid: VolumeGrid,
        *,
        n_pixels: int | None = None,
        psf_points: int = 5,
    ) -> None:
        index = slices.pixel_index
        if n_pixels is not None:
            index = index[thinned(len(index), n_pixels)]
        self.operator = VoxelOperator(slices.planes, grid, index, (1, 1, psf_points))
        self.value = slices.value[index]
        self.volume = np.ascontiguousarray(volume, dtype=np.float32)
        n_zeros = grid.shape[1] * grid.shape[2] + grid.shape[2] + 2  # the cell of pixels outside
        self.flat = np.concatenate([self.volume.ravel(), np.zeros(n_zeros, np.float32)])
        self.uv_mm = np.ascontiguousarray(self.operator.uv_mm.T)
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
            self.flat,
            np.array(op.grid.shape, np.float64),
            self.start,
            self.uv_mm,
            self.value,
            op.index_from_plane,
            op.index_center[:, None] + op.node_index,
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

    def losses(self, planes: Planes, gain: NDArray[np.float64], width: float) -> NDArray[np.float64]:
        """Mean Cauchy loss [K] of each slice, as `evaluate` has it, without derivatives; 0 for one without pixels.

        Args:
            planes: the slices' pixel grids in their present poses.
            gain: [K] intensity factors.
            width: residual at which the Cauchy loss bends.
        """
        loss = np.log1p((self.residuals(planes, gain) / np.float32(width)) ** 2)
        n_used = np.diff(self.start)
        total = np.bincount(self.operator.plane, loss, len(n_used))
        return np.asarray(total / np.maximum(n_used, 1), np.float64)

    def residuals(self, planes: Planes, gain: NDArray[np.float64]) -> NDArray[np.float32]:
        """Slice minus model for every used pixel."""
        self.operator.move(planes)
        model = gain[self.operator.plane] * self.operator.forward(self.volume)
        return self.value - model.astype(np.float32)


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=REORDERED)
def _accumulate(
    flat, shape, start, uv, value, matrix, origin, node_mm, node_weight, gain, width, hessian, gradient, loss, moments
):
    """The sums of `NormalEquations`, slice by slice, in runs of pixels (see `acquisition.kernels`)."""
    to_x, to_y, to_z = np.uint64(shape[1] * shape[2]), np.uint64(shape[2]), np.uint64(1)
    outside = int(shape[0] * shape[1] * shape[2])
    for k in numba.prange(len(start) - 1):
        cell, fraction = np.empty(RUN, np.int32), np.empty((3, RUN))
        jacobian, weighted = np.empty((N_PARAMETERS, RUN)), np.empty(RUN)
        residual, factor = np.empty(RUN), np.empty(RUN)
        m = matrix[k]
        xx, xy, xz = m[0, 0], m[0, 1], m[0, 2]
        yx, yy, yz = m[1, 0], m[1, 1], m[1, 2]
        zx, zy, zz = m[2, 0], m[2, 1], m[2, 2]
        total = 0.0
        for first in range(start[k], start[k + 1], RUN):
            end = min(first + RUN, start[k + 1])
            n = end - first
            at_u, at_v, observed = uv[0, first:end], uv[1, first:end], value[first:end]
            jacobian[:, :n] = 0.0
            turn_x, turn_y, turn_z = jacobian[0, :n], jacobian[1, :n], jacobian[2, :n]
            shift_x, shift_y, shift_z = jacobian[3, :n], jacobian[4, :n], jacobian[5, :n]
            model = jacobian[6, :n]
            for q in range(len(node_weight)):
                locate(at_u, at_v, m, origin[k, q], shape, outside, cell, fraction)
                w = node_weight[q]
                node_u, node_v, s = node_mm[k, q, 0], node_mm[k, q, 1], node_mm[k, q, 2]
                for p in range(n):
                    c = np.uint64(cell[p])
                    fx, fy, fz = fraction[0, p], fraction[1, p], fraction[2, p]
                    a000, a001 = flat[c], flat[c + to_z]
                    a010, a011 = flat[c + to_y], flat[c + to_y + to_z]
                    a100, a101 = flat[c + to_x], flat[c + to_x + to_z]
                    a110, a111 = flat[c + to_x + to_y], flat[c + to_x + to_y + to_z]
                    b00, b01 = a000 + fz * (a001 - a000), a010 + fz * (a011 - a010)
                    b10, b11 = a100 + fz * (a101 - a100), a110 + fz * (a111 - a110)
                    c0, c1 = b00 + fy * (b01 - b00), b10 + fy * (b11 - b10)
                    gx = c1 - c0
                    gy = (1.0 - fx) * (b01 - b00) + fx * (b11 - b10)
                    gz = (1.0 - fx) * ((1.0 - fy) * (a001 - a000) + fy * (a011 - a010)) + fx * (
                        (1.0 - fy) * (a101 - a100) + fy * (a111 - a110)
                    )
                    model[p] += w * (c0 + fx * gx)
                    hx = w * (xx * gx + yx * gy + zx * gz)
                    hy = w * (xy * gx + yy * gy + zy * gz)
                    hz = w * (xz * gx + yz * gy + zz * gz)
                    u, v = at_u[p] + node_u, at_v[p] + node_v
                    turn_x[p] += v * hz - s * hy
                    turn_y[p] += s * hx - u * hz
                    turn_z[p] += u * hy - v * hx
                    shift_x[p] += hx
                    shift_y[p] += hy
                    shift_z[p] += hz
            g = gain[k]
            s_y = s_m = s_yy = s_mm = s_ym = 0.0
            for p in range(n):
                y, modelled = np.float64(observed[p]), model[p]
                residual[p] = y - g * modelled
                factor[p] = g / (1.0 + (residual[p] / width) ** 2)
                s_y += y
                s_m += modelled
                s_yy += y * y
                s_mm += modelled * modelled
                s_ym += y * modelled
            moments[k, 0] += n
            moments[k, 1] += s_y
            moments[k, 2] += s_m
            moments[k, 3] += s_yy
            moments[k, 4] += s_mm
            moments[k, 5] += s_ym
            for p in range(n):
                total += math.log1p((residual[p] / width) ** 2)
            for a in range(N_PARAMETERS):
                own, along = jacobian[a], 0.0
                for p in range(n):
                    weighted[p] = factor[p] * own[p]
                    along += weighted[p] * residual[p]
                gradient[k, a] += along
                for b in range(a + 1):
                    other, both = jacobian[b], 0.0
                    for p in range(n):
                        both += weighted[p] * other[p]
                    hessian[k, b, a] += g * both
        for a in range(N_PARAMETERS):
            for b in range(a):
                hessian[k, a, b] = hessian[k, b, a]
        n_used = start[k + 1] - start[k]
        loss[k] = total / n_used if n_used > 0 else 0.0
