"""Fetal head motion in time: recorded trajectories, or a random model with their statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.interleave import place_in_time
from g3r.errors import InputError
from g3r.geometry import RigidPose

Array = NDArray[np.float64]

SAMPLE_SECONDS = 7.0
"""Interval of the recorded trajectories and of the model."""

# Fitted to the 154 trajectories of fetal heads (19,661 steps of 7 s) in traj_flat.npz, the file that comes
# with SVoRT (Xu et al., MICCAI 2022). The mean square rotation grows with the lag: 72, 98, 138, 189 deg^2 per
# axis after 1, 2, 4, 8 steps. It splits into white tracking noise (46 deg^2), which is not modelled, and a random
# walk of 15 to 25 deg^2 per step. Quiet steps (under 4 deg) have 1.4 deg and 1.3 mm per axis.
QUIET_DEG = 1.2
QUIET_MM = 0.8
JERK_SHARE = 0.06
"""Share of jerks: steps larger than five times the median step of their trajectory."""
JERK_DEG = 15.0
JERK_MM = 6.0
SPREAD_BETWEEN_SUBJECTS = 0.42
"""Standard deviation of the logarithm of a trajectory's median step."""


@dataclass(frozen=True)
class RecordedTrajectory:
    """A tracked head: `rotation` [T, 3, 3] and `translation_mm` [T, 3], every 7 s."""

    rotation: Array
    translation_mm: Array


def load_trajectories(path: str | Path) -> list[RecordedTrajectory]:
    """Trajectories of an npz file: `rot_*` [T, 3] (Euler angles xyz, rad) and `trans_*` [T, 3] (mm).

    Raises:
        InputError: no such file, another kind of file, or a trajectory that is not [T, 3].
    """
    try:
        with open(path, "rb") as stream, np.load(stream) as content:
            arrays = {name: np.asarray(content[name], dtype=np.float64) for name in content.files}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as npz; expected rot_* (rad) and trans_* (mm)") from error
    found = []
    for name in sorted(name for name in arrays if name.startswith("rot_")):
        angle, translation = arrays[name], arrays.get("trans_" + name.removeprefix("rot_"))
        if translation is None or angle.shape != translation.shape or angle.ndim != 2 or angle.shape[1] != 3:
            raise InputError(f"{path}: {name} {angle.shape} has no trans_* of its shape; expected [T, 3]")
        found.append(RecordedTrajectory(Rotation.from_euler("xyz", angle).as_matrix(), translation))
    if not found:
        raise InputError(f"{path}: holds no trajectory; expected rot_* (rad) and trans_* (mm)")
    return found


def modelled_trajectory(n_samples: int, rng: np.random.Generator) -> RecordedTrajectory:
    """A random walk of small steps and rare jerks, with the statistics of the recorded trajectories."""
    activity = np.exp(rng.normal(0, SPREAD_BETWEEN_SUBJECTS))
    jerk = rng.random((n_samples, 1)) < JERK_SHARE
    angle_deg = rng.normal(0, 1, (n_samples, 3)) * np.where(jerk, JERK_DEG, QUIET_DEG) * activity
    translation_mm = rng.normal(0, 1, (n_samples, 3)) * np.where(jerk, JERK_MM, QUIET_MM) * activity
    steps = Rotation.from_rotvec(angle_deg, degrees=True).as_matrix()
    rotation = np.empty((n_samples, 3, 3))
    rotation[0] = np.eye(3)
    for k in range(1, n_samples):
        rotation[k] = steps[k] @ rotation[k - 1]
    return RecordedTrajectory(rotation, np.cumsum(translation_mm, axis=0))


def timed_trajectory(
    n_slices: int,
    seconds_per_slice: float,
    interleave: int,
    rng: np.random.Generator,
    recorded: Sequence[RecordedTrajectory] = (),
) -> RigidPose:
    """True motion of each slice of one stack about the origin: a section of a trajectory, with its mean removed.

    Args:
        n_slices: K.
        seconds_per_slice: time between two slices.
        interleave: see `acquisition_order`.
        rng: source of randomness.
        recorded: trajectories from which the section is cut; an empty list uses the model.

    Returns:
        K poses in the order of the slices in space.
    """
    seconds = np.arange(n_slices) * seconds_per_slice
    n_samples = int(np.ceil(seconds[-1] / SAMPLE_SECONDS)) + 2
    if recorded:
        whole = recorded[int(rng.integers(len(recorded)))]
        first = int(rng.integers(max(len(whole.rotation) - n_samples, 0) + 1))
        piece = RecordedTrajectory(
            whole.rotation[first : first + n_samples], whole.translation_mm[first : first + n_samples]
        )
    else:
        piece = modelled_trajectory(n_samples, rng)
    rotations = Rotation.from_matrix(piece.rotation)
    angle = (rotations * rotations.mean().inv()).as_rotvec()
    sample_seconds = np.arange(len(angle)) * SAMPLE_SECONDS
    both = np.concatenate([angle, piece.translation_mm - piece.translation_mm.mean(0)], axis=1)
    in_time = np.stack([np.interp(seconds, sample_seconds, column) for column in both.T], axis=1)
    in_space = in_time[place_in_time(n_slices, interleave)]
    return RigidPose.from_rotvec(in_space[:, :3], in_space[:, 3:])
