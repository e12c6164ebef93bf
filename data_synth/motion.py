"""How a fetal head moves during a stack, and what registration leaves of it.

All poses are motions of world space: a point x of a slice by the file's header truly lies at R x + t.
Every function takes the generator that it draws from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from g3r.acquisition.interleave import acquisition_order
from g3r.geometry import RigidPose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionLevel:
    """How much a head moves; angles and lengths are standard deviations per axis.

    Args:
        walk_deg: random walk of the rotation vector per slice in time.
        walk_mm: random walk of the position per slice in time.
        n_jerks: sudden lasting movements per stack.
        jerk_deg: rotation of a jerk.
        jerk_mm: shift of a jerk.
        offset_deg: rotation of a whole stack.
        offset_mm: shift of a whole stack.
        dropout_share: probability that motion during a slice's excitation voids its signal.
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
    "mild": MotionLevel(0.3, 0.15, 0, 0.0, 0.0, 3.0, 2.0),
    "moderate": MotionLevel(0.6, 0.3, 2, 6.0, 3.0, 10.0, 5.0),
    "severe": MotionLevel(1.0, 0.5, 4, 15.0, 6.0, 25.0, 10.0, dropout_share=0.06),
}


def slice_trajectory(
    n_slices: int, level: MotionLevel, center_mm: Array, interleave: int, rng: np.random.Generator
) -> RigidPose:
    """True motion of each slice of one stack: a random walk with jerks in time, about a stack's own offset.

    Args:
        n_slices: K.
        level: magnitudes.
        center_mm: the head's centre [3], about which it turns.
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
    place = np.empty(n_slices, np.int64)
    place[acquisition_order(n_slices, interleave)] = np.arange(n_slices)
    return about(in_time.take(place), center_mm)


def about(pose: RigidPose, center_mm: Array) -> RigidPose:
    """The motions x -> R (x - c) + c + t for centres c [3] or [S, 3] (mm)."""
    center = np.broadcast_to(np.asarray(center_mm, dtype=np.float64), (len(pose), 3))
    turned = np.einsum("sij,sj->si", pose.rotation, center)
    return RigidPose(pose.rotation, pose.translation_mm + center - turned)


ResidualKind = Literal["none", "small", "gross"]
TAIL_SHARE, TAIL_FACTOR = 0.1, 3.0
"""Slices of few pixels and slices that fit badly are the tail of every registration."""
RESIDUAL_SHARE: dict[ResidualKind, float] = {"none": 0.2, "small": 0.65, "gross": 0.15}
"""How often a subject has which error: exact poses, good registration, registration with failures."""


def draw_residual_kind(rng: np.random.Generator) -> ResidualKind:
    """One kind of residual pose error by its share."""
    kinds: list[ResidualKind] = list(RESIDUAL_SHARE)
    return kinds[int(rng.choice(len(kinds), p=list(RESIDUAL_SHARE.values())))]


def residual_errors(
    kind: ResidualKind, stack_id: NDArray[np.int64], center_mm: Array, rng: np.random.Generator
) -> RigidPose:
    """Pose errors of the size that registration leaves behind, each about its slice's own centre.

    `small`: a subject draws a root mean square length of 0.1-0.8 mm and 0.2-1.2 degrees (medians of 0.2-0.4
    mm and 90th percentiles of 0.4-1.3 mm were measured before the joint fit, docs/motion.md); half the
    variance is independent, half shared with neighbouring slices, and one slice in ten is off by three times
    as much. `gross`: in addition one to three runs of one to six neighbouring slices that are off together by
    3-8 mm and up to 10 degrees.

    Args:
        kind: of error.
        stack_id: [S] stack of each slice; slices of a stack are neighbours in this order.
        center_mm: [S, 3] centres of the slices (where they are taken to be).
        rng: source of randomness.
    """
    n = len(stack_id)
    if kind == "none":
        return RigidPose.identity(n)
    tail = np.where(rng.random((n, 1)) < TAIL_SHARE, TAIL_FACTOR, 1.0)
    size_mm, size_deg = np.exp(rng.uniform(np.log(0.1), np.log(0.8))), rng.uniform(0.2, 1.2)
    translation_mm = _partly_shared(stack_id, rng) * tail * (size_mm / np.sqrt(3))
    angle_rad = _partly_shared(stack_id, rng) * tail * (np.deg2rad(size_deg) / np.sqrt(3))
    if kind == "gross":
        for _ in range(int(rng.integers(1, 4))):
            first = int(rng.integers(n))
            run = np.arange(first, min(first + int(rng.integers(1, 7)), n))
            run = run[stack_id[run] == stack_id[first]]
            translation_mm[run] += _direction(rng) * rng.uniform(3, 8)
            angle_rad[run] += _direction(rng) * np.deg2rad(rng.uniform(0, 10))
    return about(RigidPose.from_rotvec(angle_rad, translation_mm), center_mm)


def _partly_shared(stack_id: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Unit-variance noise [S, 3]: half its variance varies slowly from slice to slice of a stack."""
    own = rng.normal(size=(len(stack_id), 3))
    shared = rng.normal(size=(len(stack_id), 3))
    for stack in np.unique(stack_id):
        rows = stack_id == stack
        shared[rows] = gaussian_filter1d(shared[rows], 2.0, axis=0, mode="nearest") * SMOOTHING_GAIN
    return (own + shared) / np.sqrt(2)


SMOOTHING_GAIN = float(np.sqrt(2 * np.sqrt(np.pi) * 2.0))
"""Restores white noise's variance after a Gaussian filter of sigma 2 (sum w^2 = 1 / (2 sqrt(pi) sigma))."""


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
