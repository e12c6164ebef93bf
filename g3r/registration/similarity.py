"""How well slices fit a volume under many candidate motions at once, outline of the head included."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.area_profile import AreaProfile, area_profiles
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid

PIXELS_PER_SLICE = 100
"""Pixels of a slice that take part in a search; at its resolution neighbours are nearly alike."""

GAIN_RANGE = (0.6, 1.6)
"""Intensity factors of a slice that a candidate may be fitted with."""

CORRELATION_AREA_MM2 = 80.0
"""Area over which residuals are correlated at a search's resolution: one independent sample for each."""


@dataclass(frozen=True, kw_only=True)
class SearchPixels:
    """Thinned pixels of some slices as points of the world.

    Pixels of a slice's bounding box outside its mask count with value 0: the outline of the head says at
    least as much about its orientation as the anatomy inside.

    Args:
        point_mm: [P, 3].
        value: [P].
        start: [K + 1] first pixel of each slice.
        area_mm2: [K] area of the bounding box of each slice.
        center_mm: [3] mean of the masked pixels; of a stack that lacks slices, the middle of the head.
    """

    point_mm: NDArray[np.float64]
    value: NDArray[np.float32]
    start: NDArray[np.int64]
    area_mm2: NDArray[np.float64]
    center_mm: NDArray[np.float64]

    @classmethod
    def of(cls, slices: Slices, pixels_per_slice: int = PIXELS_PER_SLICE) -> SearchPixels:
        """A square lattice of about `pixels_per_slice` pixels from each slice, at the slices' poses."""
        planes = slices.planes
        chosen = []
        for k in range(len(slices)):
            number = np.arange(planes.offset[k], planes.offset[k + 1]).reshape(planes.shape[k])
            step = max(1, round(float(np.sqrt(number.size / pixels_per_slice))))
            first = np.minimum(step // 2, (np.array(number.shape) - 1) // 2)
            chosen.append(number[first[0] :: step, first[1] :: step].ravel())
        index = np.concatenate(chosen)
        mask = slices.mask[index]
        point = planes.pixel_world_mm(index)
        return cls(
            point_mm=point,
            value=np.where(mask, slices.value[index], 0).astype(np.float32),
            start=np.concatenate([[0], np.cumsum([len(c) for c in chosen])]).astype(np.int64),
            area_mm2=planes.shape.prod(1) * planes.spacing_mm.prod(1),
            center_mm=point[mask].mean(0) if mask.any() else point.mean(0),
        )

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def n_samples(self) -> float:
        """Independent samples in all slices."""
        return float(self.area_mm2.sum()) / CORRELATION_AREA_MM2

    def moments(self, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose) -> NDArray[np.float64]:
        """Sums n, y, m, yy, mm, ym [J, K, 6] of slices k in a volume under world motions j.

        y is a pixel of the slice, m the volume there (trilinear, 0 outside). The volume should be as blurred
        as the slices are thick; there is no PSF here.

        Args:
            volume: [I, J, K].
            grid: its grid.
            motion: J motions of the world.
        """
        index_from_world = np.linalg.inv(grid.affine)
        linear = index_from_world[:3, :3] @ motion.rotation
        middle = self.point_mm.mean(0)  # near it, single precision is enough
        translation = motion.translation_mm @ index_from_world[:3, :3].T + index_from_world[:3, 3] + linear @ middle
        point = np.ascontiguousarray((self.point_mm - middle).T, np.float32)
        n_cell = grid.shape[1] * grid.shape[2] + grid.shape[2] + 2
        flat = np.concatenate([volume.ravel().astype(np.float32), np.zeros(n_cell, np.float32)])
        out = np.empty((len(motion), len(self), 6))
        value = self.value.astype(np.float64)
        out[..., 0] = np.diff(self.start)
        out[..., 1] = np.add.reduceat(value, self.start[:-1])
        out[..., 3] = np.add.reduceat(value**2, self.start[:-1])
        _sums(
            flat,
            np.array(grid.shape),
            point,
            self.value,
            self.start,
            linear.astype(np.float32),
            translation.astype(np.float32),
            out,
        )
        return out


@dataclass(frozen=True, kw_only=True)
class StackSamples:
    """The thinned pixels of one stack, by the header, for the global search.

    Args:
        stack: number of the stack.
        rows: [K] which of all slices these are.
        pixels: at the header poses.
        slice_index: [K] number of each slice in its stack.
        n_candidates: random motions that are tried at once.
        profile: of the head along the stack, missing slices included.
    """

    stack: int
    rows: NDArray[np.int64]
    pixels: SearchPixels
    slice_index: NDArray[np.int64]
    n_candidates: int
    profile: AreaProfile

    @classmethod
    def of_all(cls, slices: Slices, n_candidates: int = 4000) -> list[StackSamples]:
        """One entry for each stack."""
        by_header = slices.with_pose(slices.header_pose)
        samples = []
        for stack, profile in zip(np.unique(slices.stack_id), area_profiles(slices), strict=True):
            rows = np.flatnonzero(slices.stack_id == stack)
            pixels = SearchPixels.of(by_header.take(rows))
            if profile.has_missing:
                pixels = replace(pixels, center_mm=profile.head_center_mm)
            samples.append(
                cls(
                    stack=int(stack),
                    rows=rows,
                    pixels=pixels,
                    slice_index=slices.slice_index[rows],
                    n_candidates=n_candidates,
                    profile=profile,
                )
            )
        return samples


def slice_costs(
    pixels: SearchPixels, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose
) -> NDArray[np.float64]:
    """Negative log likelihood [K, J] of slices k in a volume under motions j.

    Student's form with the noise level of a slice that fits, so that a slice with signal loss counts less.

    Args:
        pixels: of K slices.
        volume: [I, J, K].
        grid: its grid.
        motion: J motions of the world.
    """
    residual = mean_square_residual(pixels.moments(volume, grid, motion)).T
    noise = float(np.median(residual.min(1))) + 1e-12
    n_samples = pixels.area_mm2 / CORRELATION_AREA_MM2
    return n_samples[:, None] * np.log1p(residual / (2 * noise))


def own_moments(
    pixels: SearchPixels, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose
) -> NDArray[np.float64]:
    """Sums n, y, m, yy, mm, ym [K, 6] of each slice in a volume under its own motion.

    Args:
        pixels: of K slices.
        volume: [I, J, K].
        grid: its grid.
        motion: [K].
    """
    point = np.empty_like(pixels.point_mm)
    for k in range(len(pixels)):
        of_slice = slice(pixels.start[k], pixels.start[k + 1])
        point[of_slice] = pixels.point_mm[of_slice] @ motion.rotation[k].T + motion.translation_mm[k]
    return replace(pixels, point_mm=point).moments(volume, grid, RigidPose.identity(1))[0]


def correlation(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation coefficients from sums n, y, m, yy, mm, ym [..., 6]; 0 where a variance vanishes."""
    n, y, m, yy, mm, ym = np.moveaxis(moments, -1, 0)
    n = np.maximum(n, 1.0)
    var_y, var_m = yy - y * y / n, mm - m * m / n
    product = var_y * var_m
    defined = (var_y > 1e-12 * yy) & (var_m > 1e-12 * mm) & (product > 0)
    return np.where(defined, (ym - y * m / n) / np.sqrt(np.where(defined, product, 1.0)), 0.0)


def mean_square_residual(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of (y - g m)^2 [...] at the best gain g in `GAIN_RANGE`, from moments [..., 6]."""
    n, _, _, yy, mm, ym = np.moveaxis(moments, -1, 0)
    gain = np.clip(ym / np.maximum(mm, 1e-12 * yy + 1e-30), *GAIN_RANGE)
    return np.maximum(yy - 2 * gain * ym + gain**2 * mm, 0.0) / np.maximum(n, 1.0)


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=True)
def _sums(flat, shape, point, value, start, linear, translation, out):
    """The sums m, mm and ym of `SearchPixels.moments`.

    The volume is flat, followed by zeros in which points outside it lie: without a branch, and with indices that
    cannot be negative (for which numba would look), both loops over the pixels become vector code.
    """
    zero = np.float32(0)
    last_i, last_j, last_k = np.float32(shape[0] - 1), np.float32(shape[1] - 1), np.float32(shape[2] - 1)
    stride_i, stride_j = np.int32(shape[1] * shape[2]), np.int32(shape[2])
    outside = np.int32(shape[0] * shape[1] * shape[2])
    to_i, to_j, to_k = np.uint64(shape[1] * shape[2]), np.uint64(shape[2]), np.uint64(1)
    longest = (start[1:] - start[:-1]).max()
    for j in numba.prange(len(linear)):
        # as scalars: LLVM cannot know that nothing writes to the arrays inside the loops
        a_xx, a_xy, a_xz = linear[j, 0, 0], linear[j, 0, 1], linear[j, 0, 2]
        a_yx, a_yy, a_yz = linear[j, 1, 0], linear[j, 1, 1], linear[j, 1, 2]
        a_zx, a_zy, a_zz = linear[j, 2, 0], linear[j, 2, 1], linear[j, 2, 2]
        b_x, b_y, b_z = translation[j, 0], translation[j, 1], translation[j, 2]
        cell = np.empty(longest, np.int32)
        fraction_x, fraction_y = np.empty(longest, np.float32), np.empty(longest, np.float32)
        fraction_z = np.empty(longest, np.float32)
        for k in range(len(start) - 1):
            own = slice(start[k], start[k + 1])
            at_u, at_v, at_w, own_value = point[0, own], point[1, own], point[2, own], value[own]
            for p in range(len(own_value)):
                u, v, w = at_u[p], at_v[p], at_w[p]
                x = a_xx * u + a_xy * v + a_xz * w + b_x
                y = a_yx * u + a_yy * v + a_yz * w + b_y
                z = a_zx * u + a_zy * v + a_zz * w + b_z
                inside = (x >= zero) & (x < last_i) & (y >= zero) & (y < last_j) & (z >= zero) & (z < last_k)
                x, y, z = x if inside else zero, y if inside else zero, z if inside else zero
                i, h, q = np.int32(x), np.int32(y), np.int32(z)
                fraction_x[p], fraction_y[p] = x - np.float32(i), y - np.float32(h)
                fraction_z[p] = z - np.float32(q)
                cell[p] = i * stride_i + h * stride_j + q if inside else outside
            s_m = s_mm = s_ym = zero
            for p in range(len(own_value)):
                c = np.uint64(cell[p])
                fx, fy, fz = fraction_x[p], fraction_y[p], fraction_z[p]
                v00 = flat[c] + fz * (flat[c + to_k] - flat[c])
                v01 = flat[c + to_j] + fz * (flat[c + to_j + to_k] - flat[c + to_j])
                v10 = flat[c + to_i] + fz * (flat[c + to_i + to_k] - flat[c + to_i])
                v11 = flat[c + to_i + to_j] + fz * (flat[c + to_i + to_j + to_k] - flat[c + to_i + to_j])
                v0, v1 = v00 + fy * (v01 - v00), v10 + fy * (v11 - v10)
                m = v0 + fx * (v1 - v0)
                s_m += m
                s_mm += m * m
                s_ym += own_value[p] * m
            out[j, k, 2] = s_m
            out[j, k, 4] = s_mm
            out[j, k, 5] = s_ym
