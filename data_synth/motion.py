"""Simulated motion of a fetal head during a stack.

All poses are motions of world space: a point that the file's header puts at x is truly at R x + t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.interleave import place_in_time
from g3r.geometry import RigidPose

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MotionLevel:
    """Amount of motion; angles and lengths are standard deviations per axis.

    Args:
        walk_deg: random walk of the rotation vector per slice in time.
        walk_mm: random walk of the position per slice in time.
        n_jerks: sudden lasting movements per stack.
        jerk_deg: rotation of a jerk.
        jerk_mm: translation of a jerk.
        offset_deg: rotation of a whole stack.
        offset_mm: translation of a whole stack.
        dropout_share: probability that a slice loses its signal to motion during its excitation (dropout).
    """

    walk_deg: float = 0.0
    walk_mm: float = 0.0
    n_jerks: int = 0
    jerk_deg: float = 0.0
    jerk_mm: float = 0.0
    offset_deg: float = 0.0
    offset_mm: float = 0.0
    dropout_share: float = 0.0


LEVELS = {
    "none": MotionLevel(),
    "mild": MotionLevel(walk_deg=0.3, walk_mm=0.15, offset_deg=3.0, offset_mm=2.0),
    "moderate": MotionLevel(
        walk_deg=0.6, walk_mm=0.3, n_jerks=2, jerk_deg=6.0, jerk_mm=3.0, offset_deg=10.0, offset_mm=5.0
    ),
    "severe": MotionLevel(
        walk_deg=1.0,
        walk_mm=0.5,
        n_jerks=4,
        jerk_deg=15.0,
        jerk_mm=6.0,
        offset_deg=25.0,
        offset_mm=10.0,
        dropout_share=0.06,
    ),
}


def slice_trajectory(
    n_slices: int, level: MotionLevel, center_mm: Array, interleave: int, rng: np.random.Generator
) -> RigidPose:
    """True motion of each slice of one stack: a random walk in time with jerks, about an offset of the whole stack.

    Args:
        n_slices: K.
        level: magnitudes.
        center_mm: the head's centre [3], about which it rotates.
        interleave: see `acquisition_order`.
        rng: source of randomness.

    Returns:
        K poses in the order of the slices in space; the walk has zero mean, so that the offset is the
        stack's mean motion.
    """
    angle_deg = np.cumsum(rng.normal(0, 1, (n_slices, 3)) * level.walk_deg, axis=0)
    translation_mm = np.cumsum(rng.normal(0, 1, (n_slices, 3)) * level.walk_mm, axis=0)
    for _ in range(level.n_jerks):
        moment = int(rng.integers(1, max(n_slices, 2)))
        angle_deg[moment:] += rng.normal(0, level.jerk_deg, 3)
        translation_mm[moment:] += rng.normal(0, level.jerk_mm, 3)
    angle_deg -= angle_deg.mean(0)
    translation_mm -= translation_mm.mean(0)
    offset = RigidPose.from_rotvec(
        np.deg2rad(rng.normal(0, 1, (1, 3)) * level.offset_deg), rng.normal(0, 1, (1, 3)) * level.offset_mm
    )
    in_time = RigidPose.from_rotvec(np.deg2rad(angle_deg), translation_mm) @ offset
    return about(in_time.take(place_in_time(n_slices, interleave)), center_mm)


def about(pose: RigidPose, center_mm: Array) -> RigidPose:
    """The motions x -> R (x - c) + c + t for centres c [3] or [S, 3] (mm)."""
    center = np.broadcast_to(np.asarray(center_mm, dtype=np.float64), (len(pose), 3))
    rotated = np.einsum("sij,sj->si", pose.rotation, center)
    return RigidPose(pose.rotation, pose.translation_mm + center - rotated)
