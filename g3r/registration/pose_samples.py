"""How well slices fit a volume under many candidate motions at once, silhouettes included."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import rotation_matrix

PIXELS_PER_SLICE = 100
"""Pixels of a slice that take part in a search; neighbours say nearly the same at a search's resolution."""

GAIN_RANGE = (0.6, 1.6)
"""Intensity factors of a slice that a candidate may be fitted with."""

# Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3) (CVPR 2022): sqrt(2) and the real
# root of psi^4 = psi + 4.
_PHI = float(np.sqrt(2.0))
_PSI = 1.533751168755204288118041


def uniform_rotations(n: int) -> NDArray[np.float64]:
    """N rotation matrices [n, 3, 3] spread evenly over all orientations (super-Fibonacci spirals)."""
    s = np.arange(n) + 0.5
    first, second = np.sqrt(s / n), np.sqrt(1.0 - s / n)
    alpha, beta = 2 * np.pi * s / _PHI, 2 * np.pi * s / _PSI
    quaternion = [first * np.sin(alpha), first * np.cos(alpha), second * np.sin(beta), second * np.cos(beta)]
    return Rotation.from_quat(np.stack(quaternion, axis=1)).as_matrix()


def rotations_within(n_sphere: int, limit_deg: float) -> NDArray[np.float64]:
    """Those of `uniform_rotations(n_sphere)` that turn by less than a limit."""
    rotation = uniform_rotations(n_sphere)
    return rotation[angle_deg(rotation, np.eye(3)) < limit_deg]


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between rotations [..., 3, 3], broadcast against each other."""
    cosine = (np.einsum("...ij,...ij->...", *np.broadcast_arrays(a, b)) - 1) / 2
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def turns_about(
    rotation: NDArray[np.float64], center_mm: NDArray[np.float64], target_mm: NDArray[np.float64]
) -> RigidPose:
    """The motions x -> R (x - center) + target for J rotations, a center [3], targets [J, 3] or [3] (mm)."""
    return RigidPose(rotation, target_mm - rotation @ center_mm)


def perturbed(
    motion: RigidPose,
    center_mm: NDArray[np.float64],
    n_each: int,
    rotation_deg: float,
    translation_mm: float,
    rng: np.random.Generator,
) -> RigidPose:
    """Motions [J (1 + n_each)]: those given, and random ones around each.

    Args:
        motion: J motions.
        center_mm: [3] point (before the motion) about which the random turns go.
        n_each: random motions for each.
        rotation_deg: standard deviation per axis of their turns.
        translation_mm: and of their shifts.
        rng: source of randomness.
    """
    n = len(motion) * n_each
    turn = rotation_matrix(np.deg2rad(rng.normal(0, rotation_deg, (n, 3))))
    rotation = turn @ np.repeat(motion.rotation, n_each, axis=0)
    moved_center = np.repeat(motion.rotation @ center_mm + motion.translation_mm, n_each, axis=0)
    around = turns_about(rotation, center_mm, moved_center + rng.normal(0, translation_mm, (n, 3)))
    return RigidPose(
        np.concatenate([motion.rotation, around.rotation]),
        np.concatenate([motion.translation_mm, around.translation_mm]),
    )


def distinct(motion: RigidPose, center_mm: NDArray[np.float64]) -> RigidPose:
    """The motions that differ from each other by more than about 0.01 mm and 0.05 degrees."""
    place = motion.rotation @ center_mm + motion.translation_mm
    key = np.concatenate([motion.rotation.reshape(-1, 9) * 1e3, place * 100], axis=1)
    _, first = np.unique(np.rint(key).astype(np.int64), axis=0, return_index=True)
    return motion.take(np.sort(first))


@dataclass(frozen=True)
class SearchPixels:
    """Thinned pixels of some slices as points of the world, at the poses that the slices had.

    Pixels of a slice's bounding box that lie outside its mask are there with value 0: the outline of the
    head says at least as much about its orientation as what is inside.

    Args:
        point_mm: [P, 3].
        value: [P].
        start: [K + 1] first pixel of each slice.
        area_mm2: [K] area of the bounding box of each slice.
        center_mm: [3] mean masked pixel.
    """

    point_mm: NDArray[np.float64]
    value: NDArray[np.float32]
    start: NDArray[np.int64]
    area_mm2: NDArray[np.float64]
    center_mm: NDArray[np.float64]

    @classmethod
    def of(cls, slices: Slices, pixels_per_slice: int = PIXELS_PER_SLICE) -> SearchPixels:
        """A square lattice of pixels from each slice, about as many from each."""
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
            point,
            np.where(mask, slices.value[index], 0).astype(np.float32),
            np.concatenate([[0], np.cumsum([len(c) for c in chosen])]).astype(np.int64),
            planes.shape.prod(1) * planes.spacing_mm.prod(1),
            point[mask].mean(0) if mask.any() else point.mean(0),
        )

    def __len__(self) -> int:
        return len(self.start) - 1

    def moments(self, volume: NDArray[np.float32], grid: VolumeGrid, motion: RigidPose) -> NDArray[np.float64]:
        """Sums n, y, m, yy, mm, ym [J, K, 6] of slices k in a volume under world motions j.

        y is the slice's pixel, m the volume there (trilinear, 0 outside); a volume as blurred as the slices
        are thick stands for the PSF.
        """
        index_from_world = np.linalg.inv(grid.affine)
        linear = index_from_world[:3, :3] @ motion.rotation
        shift = motion.translation_mm @ index_from_world[:3, :3].T + index_from_world[:3, 3]
        out = np.zeros((len(motion), len(self), 6))
        volume = np.ascontiguousarray(volume, np.float32)
        _moments(volume, self.point_mm, self.value, self.start, linear, shift, out)
        return out


def mean_square_residual(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of (y - g m)^2 [...] at the best intensity factor g in `GAIN_RANGE`, from moments [..., 6]."""
    n, _, _, yy, mm, ym = np.moveaxis(moments, -1, 0)
    gain = np.clip(ym / np.maximum(mm, 1e-12 * yy + 1e-30), *GAIN_RANGE)
    return np.maximum(yy - 2 * gain * ym + gain**2 * mm, 0.0) / np.maximum(n, 1.0)


@numba.njit(parallel=True, cache=True, fastmath=True)
def _moments(volume, point, value, start, linear, shift, out):
    n_i, n_j, n_k = volume.shape
    for j in numba.prange(len(linear)):
        a, b = linear[j], shift[j]
        for k in range(len(start) - 1):
            s_y = s_m = s_yy = s_mm = s_ym = 0.0
            for p in range(start[k], start[k + 1]):
                u, v, w = point[p, 0], point[p, 1], point[p, 2]
                x = a[0, 0] * u + a[0, 1] * v + a[0, 2] * w + b[0]
                y = a[1, 0] * u + a[1, 1] * v + a[1, 2] * w + b[1]
                z = a[2, 0] * u + a[2, 1] * v + a[2, 2] * w + b[2]
                m = 0.0
                if 0 <= x < n_i - 1 and 0 <= y < n_j - 1 and 0 <= z < n_k - 1:
                    i, h, q = int(x), int(y), int(z)
                    fx, fy, fz = x - i, y - h, z - q
                    v00 = volume[i, h, q] + fz * (volume[i, h, q + 1] - volume[i, h, q])
                    v01 = volume[i, h + 1, q] + fz * (volume[i, h + 1, q + 1] - volume[i, h + 1, q])
                    v10 = volume[i + 1, h, q] + fz * (volume[i + 1, h, q + 1] - volume[i + 1, h, q])
                    v11 = volume[i + 1, h + 1, q] + fz * (volume[i + 1, h + 1, q + 1] - volume[i + 1, h + 1, q])
                    v0, v1 = v00 + fy * (v01 - v00), v10 + fy * (v11 - v10)
                    m = v0 + fx * (v1 - v0)
                s_y += value[p]
                s_m += m
                s_yy += value[p] * value[p]
                s_mm += m * m
                s_ym += value[p] * m
            out[j, k, 0] = start[k + 1] - start[k]
            out[j, k, 1] = s_y
            out[j, k, 2] = s_m
            out[j, k, 3] = s_yy
            out[j, k, 4] = s_mm
            out[j, k, 5] = s_ym
