"""Simulated registration errors: residual errors in the poses of slices."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from data_synth.motion import about
from g3r.geometry import RigidPose

Array = NDArray[np.float64]
ResidualKind = Literal["none", "small", "gross"]
TAIL_SHARE, TAIL_FACTOR = 0.1, 3.0
"""Share of slices with larger errors, and their factor: registration is always worse for slices with few pixels and
for slices that fit badly."""
RESIDUAL_SHARE: dict[ResidualKind, float] = {"none": 0.2, "small": 0.65, "gross": 0.15}
"""Probability of each kind for a subject: exact poses, good registration, registration with failures."""
SMOOTHING_GAIN = float(np.sqrt(2 * np.sqrt(np.pi) * 2.0))
"""Factor that restores the variance of white noise after a Gaussian filter of sigma 2
(sum w^2 = 1 / (2 sqrt(pi) sigma))."""


def draw_residual_kind(rng: np.random.Generator) -> ResidualKind:
    """Draw a kind of residual pose error with the probabilities of `RESIDUAL_SHARE`."""
    kinds: list[ResidualKind] = list(RESIDUAL_SHARE)
    return kinds[int(rng.choice(len(kinds), p=list(RESIDUAL_SHARE.values())))]


def residual_errors(
    kind: ResidualKind, stack_id: NDArray[np.int64], center_mm: Array, rng: np.random.Generator
) -> RigidPose:
    """Pose errors [S] of the size that registration leaves, each a rotation about the slice's own centre and a shift.

    `small`: a subject draws a root mean square error of 0.1-0.8 mm and 0.2-1.2 degrees (medians of 0.2-0.4
    mm and 90th percentiles of 0.4-1.3 mm were measured before the joint fit, docs/motion.md). Half the
    variance is independent, half is shared with neighbouring slices. One slice in ten has three times the error.
    `gross`: in addition, one to three groups of one to six neighbouring slices have a common error of 3-8 mm and up
    to 10 degrees.

    Args:
        kind: of error.
        stack_id: [S] stack of each slice; slices of a stack are neighbours in this order.
        center_mm: [S, 3] centres of the slices, about which the errors rotate.
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
            group = np.arange(first, min(first + int(rng.integers(1, 7)), n))
            group = group[stack_id[group] == stack_id[first]]
            translation_mm[group] += _direction(rng) * rng.uniform(3, 8)
            angle_rad[group] += _direction(rng) * np.deg2rad(rng.uniform(0, 10))
    return about(RigidPose.from_rotvec(angle_rad, translation_mm), center_mm)


def _partly_shared(stack_id: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Unit-variance noise [S, 3]: half of the variance is smooth along each stack, half is independent per slice."""
    own = rng.normal(size=(len(stack_id), 3))
    shared = rng.normal(size=(len(stack_id), 3))
    for stack in np.unique(stack_id):
        rows = stack_id == stack
        shared[rows] = gaussian_filter1d(shared[rows], 2.0, axis=0, mode="nearest") * SMOOTHING_GAIN
    return (own + shared) / np.sqrt(2)


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def mean_motion(true_pose: RigidPose, center_mm: NDArray[np.float64]) -> RigidPose:
    """Mean motion of a stack's slices, repeated [K]: all that is known of the motion of a single stack.

    Args:
        true_pose: [K] motions.
        center_mm: [3] the head's centre, about which the motions are averaged.
    """
    n = len(true_pose)
    rotation = Rotation.from_matrix(true_pose.rotation).mean()
    translation_mm = (true_pose.apply(np.tile(center_mm, (n, 1, 1)))[:, 0] - center_mm).mean(0)
    one = about(RigidPose.from_rotvec(rotation.as_rotvec()[None], translation_mm[None]), center_mm)
    return one.take(np.zeros(n, np.int64))
