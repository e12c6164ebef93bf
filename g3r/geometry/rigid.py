"""Rigid motions of world space (RAS+, mm): composition, inversion and least-squares fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Selection = NDArray[np.integer] | NDArray[np.bool_] | Sequence[int] | slice
"""Argument of `take`: indices, a mask or a slice."""

ORTHONORMALITY_TOLERANCE = 1e-6
"""Largest accepted entry of R R^T - 1; a rotation read from text has about 1e-7."""


@dataclass(frozen=True)
class RigidPose:
    """S rigid motions x -> R x + t, the T_k of G3R Eq. 2.

    Args:
        rotation: [S, 3, 3] proper rotations (det +1).
        translation_mm: [S, 3].

    Raises:
        ValueError: wrong shape, a value that is not finite, or a matrix that is not a rotation.
    """

    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation_mm, dtype=np.float64)
        if rotation.ndim != 3 or rotation.shape[1:] != (3, 3):
            raise ValueError(f"rotation has shape {rotation.shape}; expected [S, 3, 3]")
        if translation.shape != (len(rotation), 3):
            raise ValueError(f"translation_mm has shape {translation.shape}; expected [{len(rotation)}, 3]")
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ValueError("a pose holds values that are not finite")
        defect = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
        if defect > ORTHONORMALITY_TOLERANCE or (np.linalg.det(rotation) < 0).any():
            raise ValueError(f"a matrix is no proper rotation (|R R^T - 1| up to {defect:.2g})")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_mm", translation)

    @classmethod
    def identity(cls, n: int) -> RigidPose:
        """`n` identity motions."""
        return cls(np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)))

    @classmethod
    def from_rotvec(cls, rotvec_rad: ArrayLike, translation_mm: ArrayLike) -> RigidPose:
        """Motions from rotation vectors [S, 3] (axis times angle, rad) and translations [S, 3]."""
        return cls(rotation_matrix(rotvec_rad), np.asarray(translation_mm, dtype=np.float64))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> RigidPose:
        """Motions from matrices [S, 4, 4] (RAS, mm), whose rotations are made exact: files have a few decimals."""
        values = np.asarray(matrix, dtype=np.float64)
        return cls(orthonormal(values[:, :3, :3]), values[:, :3, 3])

    @classmethod
    def concatenated(cls, poses: Sequence[RigidPose]) -> RigidPose:
        """The motions of several records one after the other."""
        return cls(np.concatenate([p.rotation for p in poses]), np.concatenate([p.translation_mm for p in poses]))

    def __len__(self) -> int:
        return len(self.rotation)

    def __repr__(self) -> str:
        return f"RigidPose({len(self)} poses)"

    def __matmul__(self, other: RigidPose) -> RigidPose:
        """Composition: `a @ b` applies b first. A single motion is broadcast over the other's S."""
        rotation = self.rotation @ other.rotation
        rotated = (self.rotation @ other.translation_mm[..., None])[..., 0]
        return RigidPose(orthonormal(rotation), rotated + self.translation_mm)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The motions as matrices [S, 4, 4]."""
        found = np.tile(np.eye(4), (len(self), 1, 1))
        found[:, :3, :3], found[:, :3, 3] = self.rotation, self.translation_mm
        return found

    def inverse(self) -> RigidPose:
        """The motions that undo these."""
        transposed = self.rotation.transpose(0, 2, 1)
        return RigidPose(transposed, -(transposed @ self.translation_mm[..., None])[..., 0])

    def apply(self, points_mm: ArrayLike) -> NDArray[np.float64]:
        """Move points [S, ..., 3] (mm), the s-th block by the s-th motion."""
        points = np.asarray(points_mm, dtype=np.float64)
        middle = (1,) * (points.ndim - 2)
        translation = self.translation_mm.reshape(len(self), *middle, 3)
        return np.einsum("sij,s...j->s...i", self.rotation, points) + translation

    def rotvec_rad(self) -> NDArray[np.float64]:
        """Rotation vectors [S, 3] (rad), angle in [0, pi]."""
        return Rotation.from_matrix(self.rotation).as_rotvec()

    def take(self, index: Selection) -> RigidPose:
        """The motions at an index array, a mask or a slice."""
        return RigidPose(self.rotation[index], self.translation_mm[index])

    def with_rows(self, rows: Selection, new: RigidPose) -> RigidPose:
        """The motions with those at some rows replaced by `new` (one, or one for each row)."""
        rotation, translation = self.rotation.copy(), self.translation_mm.copy()
        rotation[rows], translation[rows] = new.rotation, new.translation_mm
        return RigidPose(rotation, translation)


def rotation_matrix(rotvec_rad: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (rad)."""
    vectors = np.asarray(rotvec_rad, dtype=np.float64)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return matrices.reshape(*vectors.shape[:-1], 3, 3)


def skew(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices [K, 3, 3] of the cross products with vectors [K, 3], a x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def right_jacobian(rotvec_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Right Jacobian of SO(3) [K, 3, 3]: exp(w + dw) = exp(w) exp(J_r(w) dw) to first order.

    Source: Sola et al., A micro Lie theory (2018), Eq. 143. Series below 1e-4 rad, where the closed form
    loses digits.
    """
    angle = np.linalg.norm(rotvec_rad, axis=1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = skew(rotvec_rad)
    return np.eye(3) - first[:, None, None] * cross + second[:, None, None] * (cross @ cross)


def orthonormal(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations nearest to [S, 3, 3] nearly orthonormal matrices (polar factor by SVD)."""
    left, _, right = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(left @ right))
    left[..., :, 2] *= sign[..., None]
    return left @ right


def fit_rigid(
    source_mm: NDArray[np.float64], target_mm: NDArray[np.float64], weight: NDArray[np.float64] | None = None
) -> RigidPose:
    """The one motion that brings points nearest to their targets in (weighted) least squares.

    Args:
        source_mm: [P, 3].
        target_mm: [P, 3] where each should go.
        weight: [P] non-negative; equal when None.

    Source: Kabsch, Acta Cryst. A32 (1976).
    """
    weight = np.ones(len(source_mm)) if weight is None else weight
    source_mean = np.average(source_mm, axis=0, weights=weight)
    target_mean = np.average(target_mm, axis=0, weights=weight)
    covariance = ((target_mm - target_mean) * weight[:, None]).T @ (source_mm - source_mean)
    rotation = orthonormal(covariance[None])
    return RigidPose(rotation, (target_mean - rotation[0] @ source_mean)[None])


def fit_rigid_robust(
    source_mm: NDArray[np.float64],
    target_mm: NDArray[np.float64],
    *,
    scale_mm: float,
    n_rounds: int,
    weight: NDArray[np.float64] | None = None,
) -> tuple[RigidPose, NDArray[np.float64]]:
    """`fit_rigid` with Cauchy weights: points that end far from their target hardly count.

    Args:
        source_mm: [P, 3].
        target_mm: [P, 3] where each should go.
        scale_mm: distance at which a point counts half.
        n_rounds: iteratively reweighted fits.
        weight: [P] non-negative, multiplied into the Cauchy weights; equal when None.

    Returns:
        The motion, and the distance [P] (mm) of every moved point from its target.
    """
    prior = np.ones(len(source_mm)) if weight is None else weight
    weight = prior
    for _ in range(n_rounds):
        pose = fit_rigid(source_mm, target_mm, weight)
        distance_mm = np.linalg.norm(pose.apply(source_mm[None])[0] - target_mm, axis=1)
        weight = prior / (1 + (distance_mm / scale_mm) ** 2)
    return pose, distance_mm
