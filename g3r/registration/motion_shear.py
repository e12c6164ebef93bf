"""The open shear in the estimated motion, reduced to what motion is likely to contain.

With slices of two orientations, shifts along the other stack's normal in proportion to the place of a slice, and tilts,
give the same pixels of a sheared head (`registration.open_strain`). So the amount of this strain in the result of a
registration is a matter of noise. A model of motion says more: motion contains the strain only if the head happens to
drift along with the place of slices. Interleaved slices that are neighbours in place are not neighbours in time, so a
random walk in time contains next to none of it; slices that are taken in the order of their places contain more. The
amount in the estimated motion is treated as a measurement with the error `SHEAR_ERROR`, and the amount in such a random
walk as its prior.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.interleave import place_in_time
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.open_strain import open_strain, tilts

logger = logging.getLogger(__name__)

Float64Array = NDArray[np.float64]

SHEAR_ERROR = 0.01
"""Standard deviation of the strain that registration of two stacks ends with: 0.011 over eleven simulated heads with
little and moderate motion, from 0.002 to 0.020."""

LEVER_MM = 30.0
"""A rotation counts as the shift of a point at this distance, about that of a pixel from the middle of its slice."""

ROBUST_SCALE_MM = 2.0
"""Slices that are further than this from the common fit count less (Cauchy), since a jerk is no drift."""

N_ROUNDS = 10

LAGS = (1, 2, 3, 4)
"""Distances, in slices in time, over which changes of motion are compared."""


@dataclass(frozen=True, kw_only=True)
class MotionShear:
    """Amount of the open strain in the motion of slices.

    Attributes:
        amount: in units of the strain.
        likely: standard deviation of the amount in a random walk with steps as large as those of this motion.
        strain: [3, 3] in world axes.
    """

    amount: float
    likely: float
    strain: Float64Array

    @property
    def excess(self) -> float:
        """The part of the amount that is error, on average."""
        return self.amount * SHEAR_ERROR**2 / (SHEAR_ERROR**2 + self.likely**2)


def without_excess_shear(slices: Slices, interleave: Sequence[int | None]) -> Slices:
    """The slices without the part of the open strain in their motion that is error.

    Args:
        slices: K slices with header poses.
        interleave: of each stack; None where it is not known.
    """
    found = motion_shear(slices, interleave)
    if found is None or found.excess == 0:
        return slices
    logger.info("open shear: %.4f in the motion, %.4f is likely, less %.4f", found.amount, found.likely, found.excess)
    pose = slices.planes.pose
    turn = Rotation.from_rotvec(-found.excess * tilts(pose.rotation[:, :, 2], found.strain)).as_matrix()
    away = pose.translation_mm - pose.translation_mm.mean(0)
    return slices.with_pose(RigidPose(turn @ pose.rotation, pose.translation_mm - found.excess * away @ found.strain))


def motion_shear(slices: Slices, interleave: Sequence[int | None]) -> MotionShear | None:
    """The open strain in the motion of slices; None unless exactly one strain is open.

    It is the robust least-squares fit of a rigid motion for each stack and one strain for all to the motions of slices.

    Args:
        slices: K slices with header poses.
        interleave: of each stack; None, where it is not known, counts as the order of places.
    """
    rows = [np.flatnonzero(slices.stack_id == stack) for stack in np.unique(slices.stack_id)]
    center, normal, shift, turn = (np.zeros((len(slices), 3)) for _ in range(4))
    motion, place = slices.world_from_header(), slices.header_pose.translation_mm
    moved = np.einsum("kij,kj->ki", motion.rotation, place) + motion.translation_mm
    for own in rows:
        mean = Rotation.from_matrix(motion.rotation[own]).mean().as_matrix()
        center[own] = place[own] @ mean.T
        center[own] += np.median(moved[own] - center[own], axis=0)
        normal[own] = slices.header_pose.rotation[own, :, 2] @ mean.T
        turn[own] = Rotation.from_matrix(motion.rotation[own] @ mean.T).as_rotvec()
    strain = open_strain(np.stack([normal[own].mean(0) for own in rows]))
    if strain is None:
        return None
    shift, center = moved - center, center - center.mean(0)
    answers = np.concatenate([shift, LEVER_MM * turn], axis=1)
    columns = [_strained(center, tilts(normal, strain), strain)]
    for own in rows:
        columns += _rigid(center, own)
    design = np.stack([column.ravel() for column in columns], axis=1)
    slope, estimate = _robust_fit(design, answers)
    # the walk is that of the head about its middle: rotations of the head shift slices that are far from there
    of_shift, of_turn = slope[:, :3], LEVER_MM * slope[:, 3:] + np.cross(center, slope[:, :3])
    variance = 0.0
    for own, order in zip(rows, interleave, strict=True):
        number = slices.slice_index[own]
        time = place_in_time(int(number.max()) + 1, order or 1)[number]
        first = np.argsort(time)
        own, time = own[first], time[first]
        about_middle = shift[own] - np.cross(turn[own], center[own])
        variance += _of_walk(about_middle, of_shift[own], time) + _of_walk(turn[own], of_turn[own], time)
    return MotionShear(amount=estimate, likely=float(np.sqrt(variance)), strain=strain)


def _strained(center: Float64Array, tilt: Float64Array, strain: Float64Array) -> Float64Array:
    """Shifts and turns [K, 6] of slices per unit of a strain."""
    return np.concatenate([center @ strain, LEVER_MM * tilt], axis=1)


def _rigid(center: Float64Array, own: NDArray[np.intp]) -> list[Float64Array]:
    """Shifts and turns [K, 6] of the slices of a stack, for a shift of it along each axis and a turn about each."""
    columns = []
    for axis in np.eye(3):
        shifted, turned = np.zeros((len(center), 6)), np.zeros((len(center), 6))
        shifted[own, :3] = axis
        turned[own] = np.concatenate(
            [np.cross(axis, center[own]), np.broadcast_to(LEVER_MM * axis, (len(own), 3))], axis=1
        )
        columns += [shifted, turned]
    return columns


def _robust_fit(design: Float64Array, answers: Float64Array) -> tuple[Float64Array, float]:
    """The first unknown of a robust fit, and its derivative by the answers [K, 6] of slices."""
    weight = np.ones(len(answers))
    for _ in range(N_ROUNDS):
        root = np.repeat(np.sqrt(weight), answers.shape[1])
        inverse = np.linalg.pinv(design * root[:, None])
        found = inverse @ (answers.ravel() * root)
        off = (answers.ravel() - design @ found).reshape(answers.shape)
        weight = 1 / (1 + (off**2).sum(1) / ROBUST_SCALE_MM**2)
    return (inverse[0] * root).reshape(answers.shape), float(found[0])


def _of_walk(states: Float64Array, slope: Float64Array, time: NDArray[np.intp]) -> float:
    """Variance of the sum of slope times states, if the states [K, 3] are a random walk with noise of their own added.

    The variance of a step is the slope of the mean squared difference of two states over their distance in time; the
    intercept is twice the variance of the noise.
    """
    pairs = [(time[lag:] - time[:-lag], ((states[lag:] - states[:-lag]) ** 2).mean(1)) for lag in LAGS]
    gap, change = (np.concatenate([pair[n] for pair in pairs]) for n in range(2))
    if len(np.unique(gap)) < 2:  # with one distance in time, noise cannot be told from steps
        step = float((change / gap).mean()) if len(gap) else 0.0
    else:
        step = max(0.0, float(np.polyfit(gap, change, 1)[0]))
    later = np.cumsum(slope[::-1], axis=0)[::-1][1:]
    return float(step * (np.diff(time)[:, None] * later**2).sum())
