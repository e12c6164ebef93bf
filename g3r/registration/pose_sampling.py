"""Candidate poses: rotations spread over SO(3), and random motions around given ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.geometry import RigidPose
from g3r.geometry.rigid import rotation_matrix

# sqrt(2) and the real root of psi^4 = psi + 4, see `uniform_rotations`
_PHI = float(np.sqrt(2.0))
_PSI = 1.533751168755204288118041


def uniform_rotations(n: int) -> NDArray[np.float64]:
    """`n` rotation matrices [n, 3, 3] spread evenly over SO(3).

    Source: Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
    """
    s = np.arange(n) + 0.5
    first, second = np.sqrt(s / n), np.sqrt(1.0 - s / n)
    alpha, beta = 2 * np.pi * s / _PHI, 2 * np.pi * s / _PSI
    quaternion = [first * np.sin(alpha), first * np.cos(alpha), second * np.sin(beta), second * np.cos(beta)]
    return Rotation.from_quat(np.stack(quaternion, axis=1)).as_matrix()


def rotations_within(n_uniform: int, limit_deg: float) -> NDArray[np.float64]:
    """The rotations of `uniform_rotations(n_uniform)` whose angle is below a limit."""
    rotation = uniform_rotations(n_uniform)
    return rotation[angle_deg(rotation, np.eye(3)) < limit_deg]


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between rotations [..., 3, 3], broadcast against each other."""
    cosine = (np.einsum("...ij,...ij->...", *np.broadcast_arrays(a, b)) - 1) / 2
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def rotations_about(
    rotation: NDArray[np.float64], center_mm: NDArray[np.float64], target_mm: NDArray[np.float64]
) -> RigidPose:
    """The motions x -> R (x - center) + target.

    Args:
        rotation: [J, 3, 3].
        center_mm: [3] point about which to rotate.
        target_mm: [3] or [J, 3] where that point is taken.
    """
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
        center_mm: [3] point (before the motion) about which the random rotations go.
        n_each: random motions for each.
        rotation_deg: standard deviation of their rotation vectors per axis.
        translation_mm: standard deviation of their translations per axis.
        rng: source of randomness.
    """
    n = len(motion) * n_each
    rotation = rotation_matrix(np.deg2rad(rng.normal(0, rotation_deg, (n, 3))))
    rotation = rotation @ np.repeat(motion.rotation, n_each, axis=0)
    moved_center = np.repeat(motion.rotation @ center_mm + motion.translation_mm, n_each, axis=0)
    around = rotations_about(rotation, center_mm, moved_center + rng.normal(0, translation_mm, (n, 3)))
    return RigidPose.concatenated([motion, around])


def distinct(motion: RigidPose, center_mm: NDArray[np.float64]) -> RigidPose:
    """The motions that differ from each other by more than about 0.01 mm and 0.05 degrees."""
    place = motion.rotation @ center_mm + motion.translation_mm
    key = np.concatenate([motion.rotation.reshape(-1, 9) * 1e3, place * 100], axis=1)
    _, first = np.unique(np.rint(key).astype(np.int64), axis=0, return_index=True)
    return motion.take(np.sort(first))
