"""Coverage of voxels by whole slices, masked or not: the density M_rho of G3R Eq. 6.

A pixel outside the mask was measured like one inside it. So the density of Eq. 6 is summed over the field of view of a
slice, not over its mask. The share of it that masks call brain is a separate map (`brain_share`).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import VolumeGrid

UNSEEN_POWER = 4
"""Unseen voxels have the weight (1 - c)^4 = exp(-4 M): 1 without coverage, 0.45 where M = 0.2, 0.02 under one gapless
stack."""

REACH_SIGMA = 5.0
"""Where the profile of a slice is cut off; a millionth of its integral lies beyond."""

UNSEEN_BELOW = 0.2
"""M_rho below which a voxel counts as unseen: that of a lone slice at 0.75 of its thickness from its centre."""


def coverage(slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating] | None = None) -> NDArray[np.float32]:
    """M_rho: the density with which slices sample space, over their whole fields of view (G3R Eq. 6).

    The in-plane integral over a rectangle is a product of error functions, so no pixels are summed and the result does
    not depend on the pixel size. Dimensionless: 1 where one gapless stack covers once (thickness times the
    unit-integral profile). Slices beyond the masked ones of a stack count, too (`FieldsOfView.n_beyond`), where they
    would lie if they moved with the last masked one. Empty slices and unmasked ones between masked ones do not count.

    Args:
        slices: K slices in place.
        grid: of the result.
        weight: [K] from 0 to 1 of each slice; one for all when None.

    Returns:
        [I, J, K] float32.

    Source: G3R Eq. 6, made dimensionless (docs/method.md).
    """
    planes = slices.planes
    view = slices.fields_of_view
    amount_mm = slices.thickness_mm * (1.0 if weight is None else np.asarray(weight, np.float64))
    row, step = _with_beyond(view.n_beyond)
    center = planes.center_mm[row] + (step * view.spacing_mm[row])[:, None] * planes.rotation[row][:, :, 2]
    plane_from_world = planes.rotation[row].transpose(0, 2, 1)
    plane_from_index = plane_from_world @ grid.affine[:3, :3]
    offset = np.einsum("kij,kj->ki", plane_from_world, grid.affine[:3, 3] - center)
    density = np.zeros(grid.shape, np.float32)
    _accumulate(
        density,
        np.ascontiguousarray(plane_from_index),
        offset,
        np.sqrt(np.maximum(planes.psf_var_mm2[row], 1e-12)),
        view.extent_mm[row],
        amount_mm[row],
    )
    return density


def brain_share(masked: NDArray[np.floating], density: NDArray[np.floating]) -> NDArray[np.float32]:
    """Share of the coverage that masks call brain, in [0, 1]; 0 where nothing was measured.

    Args:
        masked: density of the masked pixels alone, as `coarse_and_density` gives it.
        density: of the whole slices, from `coverage`.
    """
    share = np.divide(masked, density, out=np.zeros_like(masked), where=density > 1e-3)
    return np.clip(share, 0, 1).astype(np.float32)


def _with_beyond(n_beyond: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of slices and steps along their normals (in slice spacings): all slices, then those beyond the ends."""
    rows: list[NDArray[np.int64]] = [np.arange(len(n_beyond))]
    steps: list[NDArray[np.float64]] = [np.zeros(len(n_beyond))]
    for side, sign in ((0, -1.0), (1, 1.0)):
        for k in np.flatnonzero(n_beyond[:, side]):
            n = int(n_beyond[k, side])
            rows.append(np.full(n, k))
            steps.append(sign * np.arange(1.0, n + 1))
    return np.concatenate(rows), np.concatenate(steps)


@numba.njit(parallel=True, nogil=True, cache=True)
def _accumulate(density, plane_from_index, offset, sigma, extent, amount):
    n_i, n_j, n_k = density.shape
    root2 = math.sqrt(2.0)
    for i in numba.prange(n_i):
        for p in range(len(amount)):
            if amount[p] == 0.0:
                continue
            # lengths in standard deviations of the slice's profile
            m, per_sigma = plane_from_index[p] / sigma[p].reshape(3, 1), 1.0 / sigma[p]
            low, high = extent[p, :, 0] * per_sigma[:2], extent[p, :, 1] * per_sigma[:2]
            peak = amount[p] * per_sigma[2] / math.sqrt(2.0 * math.pi)
            for j in range(n_j):
                x = offset[p, 0] * per_sigma[0] + m[0, 0] * i + m[0, 1] * j
                y = offset[p, 1] * per_sigma[1] + m[1, 0] * i + m[1, 1] * j
                z = offset[p, 2] * per_sigma[2] + m[2, 0] * i + m[2, 1] * j
                first, last = 0, n_k
                if abs(m[2, 2]) * n_k > 1e-9 * REACH_SIGMA:
                    a, b = (-REACH_SIGMA - z) / m[2, 2], (REACH_SIGMA - z) / m[2, 2]
                    first = max(first, math.ceil(max(min(a, b), -1.0)))
                    last = min(last, math.floor(min(max(a, b), float(n_k))) + 1)
                elif abs(z) > REACH_SIGMA:
                    continue
                for k in range(first, last):
                    height = z + m[2, 2] * k
                    value = peak * math.exp(-0.5 * height * height)
                    for axis in range(2):
                        place = (x if axis == 0 else y) + m[axis, 2] * k
                        from_low, to_high = place - low[axis], high[axis] - place
                        if min(from_low, to_high) < REACH_SIGMA:
                            value *= 0.5 * (math.erf(from_low / root2) + math.erf(to_high / root2))
                    density[i, j, k] += value
