"""Random slice poses without images: stacks planned on the head or at random, and motion during their acquisition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.motion import LEVELS, slice_trajectory
from data_synth.trajectories import RecordedTrajectory, timed_trajectory
from g3r.acquisition.interleave import place_in_time
from g3r.geometry import RigidPose

Array = NDArray[np.float64]

N_STACKS_SHARE = {1: 0.15, 2: 0.15, 3: 0.4, 4: 0.15, 5: 0.08, 6: 0.07}
PLANNED_SHARE = 0.7
"""Share of sets whose stacks are planned along the axes of the head; the others have random orientations."""
PLAN_TILT_DEG = 8.0
CUT_SHARE = 0.12
"""Share of stacks that do not cover the whole head."""
TIMED_SHARE = 0.3
"""Share of sets with trajectories in time, recorded or modelled; the others use the motion levels of the simulator."""
LEVEL_SHARE = {"none": 0.15, "mild": 0.25, "moderate": 0.35, "severe": 0.25}
TIMED_OFFSET_DEG, TIMED_OFFSET_MM = 20.0, 5.0
"""Offset of a whole stack that follows a trajectory in time: largest standard deviation of its rotation, and standard
deviation of its translation."""


@dataclass(frozen=True, kw_only=True)
class PlannedSlices:
    """Poses and thicknesses of the slices of several stacks.

    Args:
        header_pose: [K] poses that map slices to the atlas frame, by the headers.
        true_pose: [K] poses that map slices to the atlas frame, with motion.
        thickness_mm: [K].
        time_rank: [K] acquisition rank, 0 to 1 within a stack; NaN if the order is unknown.
        stack_id: [K].
    """

    header_pose: RigidPose
    true_pose: RigidPose
    thickness_mm: Array
    time_rank: Array
    stack_id: NDArray[np.int64]

    def take(self, index: NDArray[np.int64]) -> PlannedSlices:
        """The slices at the given indices."""
        return PlannedSlices(
            header_pose=self.header_pose.take(index),
            true_pose=self.true_pose.take(index),
            thickness_mm=self.thickness_mm[index],
            time_rank=self.time_rank[index],
            stack_id=self.stack_id[index],
        )


def draw_stacks(
    corners_mm: Array,
    rng: np.random.Generator,
    n_stacks: int | None = None,
    recorded: Sequence[RecordedTrajectory] = (),
) -> PlannedSlices:
    """Random poses of all slices of one to six stacks that may cross the head.

    The scanner frame is taken to be the frame of a head that has not moved. This loses no generality, because only
    relative poses of headers are used later.

    Args:
        corners_mm: [8, 3] corners of the head's bounding box, in the atlas frame.
        rng: source of randomness.
        n_stacks: None draws 1 to 6.
        recorded: trajectories to follow instead of the model's.
    """
    if n_stacks is None:
        n_stacks = int(rng.choice(list(N_STACKS_SHARE), p=list(N_STACKS_SHARE.values())))
    thickness = float(rng.uniform(2.0, 5.0) if rng.random() < 0.4 else rng.uniform(2.0, 3.5))
    gap = 0.0 if rng.random() < 0.6 else float(rng.uniform(0.0, 2.0))
    level = LEVELS[str(rng.choice(list(LEVEL_SHARE), p=list(LEVEL_SHARE.values())))]
    timed = rng.random() < TIMED_SHARE
    interleave = int(rng.integers(1, 4))
    order_known = rng.random() < 0.5
    planned = rng.random() < PLANNED_SHARE
    common = Rotation.random(random_state=rng) if not planned and rng.random() < 0.5 else None
    axes = rng.permutation(3)
    stacks = []
    for stack in range(n_stacks):
        if planned or common is not None:
            plan = planned_rotation(int(axes[stack % 3]), rng)
            rotation = plan if common is None else common.as_matrix() @ plan
        else:
            rotation = Rotation.random(random_state=rng).as_matrix()
        z = _slice_depths(corners_mm @ rotation[:, 2], thickness + gap, rng)
        pose = RigidPose(np.broadcast_to(rotation, (len(z), 3, 3)), z[:, None] * rotation[:, 2])
        if timed:
            motion = timed_trajectory(len(z), rng.uniform(0.8, 2.5), interleave, rng, recorded)
            angle_rad = np.deg2rad(rng.normal(0, rng.uniform(0, TIMED_OFFSET_DEG), (1, 3)))
            motion = motion @ RigidPose.from_rotvec(angle_rad, rng.normal(0, TIMED_OFFSET_MM, (1, 3)))
        else:
            motion = slice_trajectory(len(z), level, np.zeros(3), interleave, rng)
        time_rank = place_in_time(len(z), interleave) / max(len(z) - 1, 1)
        stacks.append((pose, motion @ pose, time_rank if order_known else np.full(len(z), np.nan)))
    n_slices = [len(pose) for pose, _, _ in stacks]
    return PlannedSlices(
        header_pose=RigidPose.concatenated([header for header, _, _ in stacks]),
        true_pose=RigidPose.concatenated([true for _, true, _ in stacks]),
        thickness_mm=np.full(sum(n_slices), thickness),
        time_rank=np.concatenate([rank for _, _, rank in stacks]),
        stack_id=np.repeat(np.arange(n_stacks), n_slices),
    )


def _slice_depths(corner_depth_mm: Array, step_mm: float, rng: np.random.Generator) -> Array:
    """Depths of a stack's slices [K] (mm) over the head, or over a part of it."""
    low, high = corner_depth_mm.min() - 5, corner_depth_mm.max() + 5
    if rng.random() < CUT_SHARE:
        cut = rng.uniform(0.1, 0.35) * (high - low)
        low, high = (low + cut, high) if rng.random() < 0.5 else (low, high - cut)
    return np.arange(low + rng.uniform(0, step_mm), high, step_mm)


def planned_rotation(axis: int, rng: np.random.Generator) -> Array:
    """Axes (columns x, y, normal) of a stack along an axis of the head, with random tilt, turn in plane and flip."""
    normal = np.roll([1.0, 0.0, 0.0], axis) * rng.choice([-1.0, 1.0])
    x = np.roll(normal, 1)
    base = np.stack([x, np.cross(normal, x), normal], axis=1)
    tilt = Rotation.from_rotvec(rng.normal(0, PLAN_TILT_DEG, 3), degrees=True).as_matrix()
    in_plane = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    return tilt @ base @ in_plane
