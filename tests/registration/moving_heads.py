"""Small moving heads with known true poses, for the tests of registration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from data_synth.simulator import SimulatedStack, orthogonal_settings, simulate_stacks
from g3r.acquisition.orientations import mean_normals
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid_robust
from g3r.registration import Registration
from g3r.registration.open_strain import open_strain, tilts

STILL = MotionLevel()


@dataclass(frozen=True)
class Moving:
    """A moving head, its true poses, and one registration with all layers."""

    stacks: list[SimulatedStack]
    slices: Slices
    truth: RigidPose
    estimate: Registration
    progress: list[tuple[int, int]]


def simulated(
    head: Phantom,
    level: MotionLevel | Sequence[MotionLevel] = STILL,
    *,
    n_stacks: int = 3,
    seed: int = 0,
    interleave: int = 2,
) -> list[SimulatedStack]:
    """Noise-free thick stacks of a head, with one level of motion for all or one for each."""
    settings = orthogonal_settings(
        n_stacks, resolution_mm=1.5, thickness_mm=4.0, snr=60.0, bias=0.0, gain_deviation=0.0
    )
    levels = [level] * n_stacks if isinstance(level, MotionLevel) else level
    settings = [
        replace(one, motion=of_stack, interleave=interleave) for one, of_stack in zip(settings, levels, strict=True)
    ]
    return simulate_stacks(head.t2, head.mask, head.affine, settings, np.random.default_rng(seed))


def as_slices(stacks: list[SimulatedStack]) -> tuple[Slices, RigidPose]:
    """Slices with intensities of order one, and the true motion of each."""
    slices = slices_from_stacks([one.stack for one in stacks])
    slices = slices.scaled(1 / float(np.percentile(slices.masked_value, 99)))
    poses = [one.true_pose for one in stacks]
    chosen = [
        (poses[s].rotation[k], poses[s].translation_mm[k])
        for s, k in zip(slices.stack_id, slices.slice_index, strict=True)
    ]
    return slices, RigidPose(np.array([c[0] for c in chosen]), np.array([c[1] for c in chosen]))


def pixel_errors_mm(slices: Slices, truth: RigidPose) -> np.ndarray:
    """Distance [P'] of every masked pixel from its true place after removal of one global motion.

    The global motion is fitted robustly, so that slices astray do not tilt it.
    """
    found, true = slices.planes.pixel_world_mm(slices.pixel_index), true_places_mm(slices, truth)
    return fit_rigid_robust(found, true, scale_mm=1.0, n_rounds=8)[1]


def true_places_mm(slices: Slices, truth: RigidPose) -> np.ndarray:
    """True position of every masked pixel [P', 3]."""
    header = slices.planes.with_pose(slices.header_pose).pixel_world_mm(slices.pixel_index)
    plane = slices.pixel_plane
    return np.einsum("pij,pj->pi", truth.rotation[plane], header) + truth.translation_mm[plane]


def slices_disturbed(slices: Slices, degrees: float, mm: float, seed: int = 0) -> Slices:
    """Slices, each rotated and shifted at random about its own centre."""
    rng = np.random.default_rng(seed)
    turn = RigidPose.from_rotvec(np.deg2rad(rng.normal(0, degrees, (len(slices), 3))), np.zeros((len(slices), 3)))
    pose = slices.planes.pose @ turn
    return slices.with_pose(RigidPose(pose.rotation, pose.translation_mm + rng.normal(0, mm, (len(slices), 3))))


def stack_moved(motion: RigidPose, slices: Slices, stack: int, by: RigidPose) -> RigidPose:
    """Motions [K], with an additional motion for one stack."""
    rows = slices.stack_id == stack
    after = by @ motion
    return RigidPose(
        np.where(rows[:, None, None], after.rotation, motion.rotation),
        np.where(rows[:, None], after.translation_mm, motion.translation_mm),
    )


def turned_about(center_mm: np.ndarray, rotvec_rad: np.ndarray, translation_mm: np.ndarray) -> RigidPose:
    """One motion: a rotation about a point, then a shift."""
    turn = RigidPose.from_rotvec([rotvec_rad], np.zeros((1, 3)))
    return RigidPose(turn.rotation, (center_mm - turn.rotation[0] @ center_mm + translation_mm)[None])


def with_jerk(slices: Slices, at: np.ndarray) -> Slices:
    """Slices of a head that had moved during some of them, with poses still by the headers."""
    center_mm = slices.planes.pixel_world_mm(slices.pixel_index).mean(0)
    jerk = turned_about(center_mm, np.deg2rad([14.0, -10.0, 8.0]), np.array([5.0, 7.0, -6.0]))
    header = slices.header_pose
    moved = jerk @ header.take(at)
    header = header.with_rows(at, moved)
    return replace(slices, header_pose=header, planes=slices.planes.with_pose(header))


def off_mm(slices: Slices, true: Slices) -> np.ndarray:
    """Mean distance [K] of the masked pixels of each slice from their true positions."""
    there = [one.planes.pixel_world_mm(one.pixel_index) for one in (slices, true)]
    apart = np.linalg.norm(there[0] - there[1], axis=1)
    return np.bincount(slices.pixel_plane, apart, len(slices)) / np.bincount(slices.pixel_plane)


def rotation_angle_deg(rotation: np.ndarray) -> float:
    """Angle of a rotation [3, 3]."""
    return float(np.rad2deg(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


def sheared(slices: Slices, amount: float) -> Slices:
    """Slices after the open shear, which to first order changes none of their pixels."""
    strain, pose = open_strain(mean_normals(slices)), slices.planes.pose
    assert strain is not None
    turn = Rotation.from_rotvec(amount * tilts(pose.rotation[:, :, 2], strain)).as_matrix()
    moved = pose.translation_mm + amount * pose.translation_mm @ strain
    return slices.with_pose(RigidPose(turn @ pose.rotation, moved))
