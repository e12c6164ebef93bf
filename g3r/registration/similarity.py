"""Similarity of slices and a volume under many candidate motions at once, outline of the head included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.area_profile import AreaProfile, area_profiles
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.pose_sampling import perturbed
from g3r.registration.similarity_kernels import model_sums

PIXELS_PER_SLICE = 100
"""Pixels of a slice that are used in a search; at its resolution neighbouring pixels are nearly alike."""

GAIN_RANGE = (0.6, 1.6)
"""Range of the gain of a slice that is fitted for each candidate."""

CORRELATION_AREA_MM2 = 80.0
"""Area over which residuals are correlated at the resolution of a search, so that it holds one independent sample."""


@dataclass(frozen=True, kw_only=True)
class SearchPixels:
    """Thinned pixels of some slices as points of the world.

    Pixels of a slice's bounding box outside its mask count with value 0: the outline of the head tells at
    least as much about its orientation as the anatomy inside.

    Args:
        point_mm: [P, 3].
        value: [P].
        start: [K + 1] first pixel of each slice.
        area_mm2: [K] area of the bounding box of each slice.
        center_mm: [3] mean of the masked pixels; the middle of the head for a stack that lacks slices.
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
            area_mm2=planes.shape.prod(1) * planes.pixel_area_mm2,
            center_mm=point[mask].mean(0) if mask.any() else point.mean(0),
        )

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def n_samples(self) -> float:
        """Independent samples in all slices."""
        return float(self.area_mm2.sum()) / CORRELATION_AREA_MM2

    def moments(
        self, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose, *, nearest: bool = False
    ) -> NDArray[np.float64]:
        """Sums n, y, m, yy, mm, ym [J, K, 6] of slices k in a volume under world motions j.

        y is a pixel of the slice, m the volume there (trilinear, 0 outside). The volume should be as blurred
        as the slices are thick; there is no PSF here.

        Args:
            volume: [I, J, K].
            grid: its grid.
            motion: J motions of the world.
            nearest: m is the nearest voxel instead, in a third of the time.
        """
        index_from_world = np.linalg.inv(grid.affine)
        linear = index_from_world[:3, :3] @ motion.rotation
        middle = self.point_mm.mean(0)  # relative to it, single precision is enough
        translation = motion.translation_mm @ index_from_world[:3, :3].T + index_from_world[:3, 3] + linear @ middle
        point = np.ascontiguousarray((self.point_mm - middle).T, np.float32)
        n_cell = grid.shape[1] * grid.shape[2] + grid.shape[2] + 2
        flat = np.concatenate([volume.ravel().astype(np.float32), np.zeros(n_cell, np.float32)])
        out = np.empty((len(motion), len(self), 6))
        value = self.value.astype(np.float64)
        out[..., 0] = np.diff(self.start)
        out[..., 1] = np.add.reduceat(value, self.start[:-1])
        out[..., 3] = np.add.reduceat(value**2, self.start[:-1])
        model_sums(
            flat,
            np.array(grid.shape),
            point,
            self.value,
            self.start,
            linear.astype(np.float32),
            translation.astype(np.float32),
            None if nearest else True,
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

    The noise is that of a slice that fits (`student_cost`). The volume is interpolated to half the voxel size and read
    at the nearest voxel.

    Args:
        pixels: of K slices.
        volume: [I, J, K].
        grid: its grid.
        motion: J motions of the world.
    """
    residual = mean_square_residual(pixels.moments(*halved_voxels(volume, grid), motion, nearest=True)).T
    noise = float(np.median(residual.min(1))) + 1e-12
    return student_cost(residual, noise, pixels.area_mm2)


def student_cost(residual: NDArray[np.float64], noise: float, area_mm2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Negative log likelihood [K, J] of Student's t form, so that a slice with signal loss counts less.

    Args:
        residual: [K, J] mean square residual of slices k under motions j.
        noise: mean square residual of a slice that fits.
        area_mm2: [K] of the slices.
    """
    n_samples = area_mm2 / CORRELATION_AREA_MM2
    return n_samples[:, None] * np.log1p(residual / (2 * noise))


def halved_voxels(volume: NDArray[np.float32], grid: VolumeGrid) -> tuple[NDArray[np.float32], VolumeGrid]:
    """A volume with a linearly interpolated value between any two voxels, and its grid.

    Args:
        volume: [I, J, K].
        grid: its grid.

    Returns:
        [2 I - 1, 2 J - 1, 2 K - 1] between the same outermost centres, and a grid of half the spacing.
    """
    for axis in range(3):
        coarse = np.moveaxis(volume, axis, 0)
        fine = np.empty((2 * len(coarse) - 1, *coarse.shape[1:]), np.float32)
        fine[::2] = coarse
        fine[1::2] = (coarse[:-1] + coarse[1:]) / 2
        volume = np.moveaxis(fine, 0, axis)
    return volume, VolumeGrid(volume.shape, grid.affine @ np.diag([0.5, 0.5, 0.5, 1.0]))


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


def random_climb(
    pixels: SearchPixels,
    volume: NDArray[np.float32],
    grid: VolumeGrid,
    motion: RigidPose,
    rounds: Sequence[tuple[float, float]],
    n_candidates: int,
    rng: np.random.Generator,
) -> tuple[RigidPose, float]:
    """The motion [1] that fits all slices together best to a volume, by random steps from the best so far.

    Args:
        pixels: of K slices.
        volume: [I, J, K].
        grid: its grid.
        motion: [1] to start from.
        rounds: standard deviations of random rotations (degrees) and translations (mm), round by round.
        n_candidates: random motions in each round.
        rng: source of randomness.

    Returns:
        The motion, and the correlation of all pixels under it.
    """
    agreement = np.zeros(1)
    for rotation_deg, translation_mm in rounds:
        candidate = perturbed(motion, pixels.center_mm, n_candidates, rotation_deg, translation_mm, rng)
        agreement = correlation(pixels.moments(volume, grid, candidate).sum(1))
        motion = candidate.take([int(agreement.argmax())])
    return motion, float(agreement.max())


def mean_square_residual(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of (y - g m)^2 [...] at the best gain g in `GAIN_RANGE`, from moments [..., 6]."""
    n, _, _, yy, mm, ym = np.moveaxis(moments, -1, 0)
    gain = best_gain(moments, GAIN_RANGE)
    return np.maximum(yy - 2 * gain * ym + gain**2 * mm, 0.0) / np.maximum(n, 1.0)


def best_gain(moments: NDArray[np.float64], gain_range: tuple[float, float]) -> NDArray[np.float64]:
    """The gain g [...] in a range with the least sum of (y - g m)^2, from moments [..., 6]."""
    _, _, _, yy, mm, ym = np.moveaxis(moments, -1, 0)
    return np.clip(ym / np.maximum(mm, 1e-12 * yy + 1e-30), *gain_range)
