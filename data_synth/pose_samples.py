"""Sets of slice images with their true poses in the atlas frame, made in milliseconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.motion import LEVELS, slice_trajectory
from data_synth.slice_sampling import Head, sample_masks, sample_slices
from data_synth.trajectories import RecordedTrajectory, timed_trajectory
from g3r.acquisition.interleave import acquisition_order
from g3r.acquisition.slice_images import SliceImages
from g3r.geometry import RigidPose

Array = NDArray[np.float64]

N_STACKS_SHARE = {1: 0.15, 2: 0.15, 3: 0.4, 4: 0.15, 5: 0.08, 6: 0.07}
PLANNED_SHARE = 0.7
"""Share of sets whose stacks were planned on the head's own axes; the others lie anywhere on the sphere."""
PLAN_TILT_DEG = 8.0
TIMED_SHARE = 0.3
"""Share of sets that move as recorded heads do; the others follow the simulator's levels."""
LEVEL_SHARE = {"none": 0.15, "mild": 0.25, "moderate": 0.35, "severe": 0.25}
TIMED_OFFSET_DEG, TIMED_OFFSET_MM = 20.0, 5.0
"""Stacks that follow a trajectory in time: largest standard deviation of a stack's turn, and its shift's."""
MIN_AREA_MM2 = 60.0
LOOK_PIXEL_MM, LOOK_SIZE = 5.0, 36
"""The quick look at where in the field of view the head is."""


@dataclass(frozen=True)
class SliceSet:
    """Slice images of one head and the answer.

    Args:
        images: what the network sees.
        true_pose: [K] atlas frame from the image's frame.
    """

    images: SliceImages
    true_pose: RigidPose


def draw_slice_set(
    head: Head,
    rng: np.random.Generator,
    pixel_mm: float = 3.0,
    size: int = 40,
    max_slices: int = 64,
    n_stacks: int | None = None,
    recorded: Sequence[RecordedTrajectory] = (),
    vary: bool = True,
) -> SliceSet:
    """One set from a head: stacks planned, moved, sliced; shape and intensities varied.

    Args:
        head: the truth.
        rng: source of randomness.
        pixel_mm: edge of the square pixels.
        size: pixels per edge.
        max_slices: of all stacks together; above it slices are left out at random.
        n_stacks: None draws 1 to 6.
        recorded: trajectories to follow instead of the model's.
        vary: False leaves shape and intensities as they are (noise, gain and voids too).
    """
    shape = _random_shape(rng) if vary else np.eye(3)
    index_from_atlas = np.linalg.inv(head.affine) @ _homogeneous(np.linalg.inv(shape))
    header, true, thickness_mm, time_rank, stack_id = _draw_stacks(head, shape, rng, n_stacks, recorded)
    threshold = float(rng.uniform(0.3, 0.6)) if vary else 0.5

    # where each stack's mask is by its header, from a quick look at large pixels
    look = sample_masks(head, index_from_atlas, true, LOOK_PIXEL_MM, LOOK_SIZE, threshold)
    area = look.sum((1, 2)) * LOOK_PIXEL_MM**2
    kept = _thinned(np.flatnonzero(area > MIN_AREA_MM2), max_slices, rng)
    header, true, look, area = header.take(kept), true.take(kept), look[kept], area[kept]
    thickness_mm, time_rank = thickness_mm[kept], time_rank[kept]
    _, stack_id = np.unique(stack_id[kept], return_inverse=True)
    translation_mm = _shift_to_centroid(look, area, header, stack_id, LOOK_PIXEL_MM)

    frame = RigidPose.from_rotvec(np.zeros_like(translation_mm), translation_mm * [1, 1, 0])
    true = true @ frame
    image, inside = sample_slices(head, index_from_atlas, true, thickness_mm, pixel_mm, size, threshold)
    if vary:
        image = _random_intensities(image, inside, true, pixel_mm, rng)
    bright = np.percentile(image[inside > 0.5], 99) if (inside > 0.5).any() else 1.0
    images = SliceImages(
        image=(image / max(bright, 1e-6)).astype(np.float32),
        area_mm2=inside.sum((1, 2)) * pixel_mm**2,
        position_mm=-translation_mm[:, 2],
        thickness_mm=thickness_mm,
        time_rank=time_rank,
        stack_id=stack_id.astype(np.int64),
        header_rotation=header.rotation,
        frame_in_slice=frame,
    )
    return SliceSet(images, true)


def _draw_stacks(
    head: Head, shape: Array, rng: np.random.Generator, n_stacks: int | None, recorded: Sequence[RecordedTrajectory]
) -> tuple[RigidPose, RigidPose, Array, Array, NDArray[np.int64]]:
    """Header poses, true poses, thickness, rank in time and stack of all slices that may meet the head.

    The scanner's axes are taken as those of a head that did not move; only relations between headers are
    used later, so nothing is lost by it.
    """
    if n_stacks is None:
        n_stacks = int(rng.choice(list(N_STACKS_SHARE), p=list(N_STACKS_SHARE.values())))
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(head.data.shape) - 1)
    corners = (corners @ head.affine[:3, :3].T + head.affine[:3, 3]) @ shape.T
    thickness = float(rng.uniform(2.0, 5.0) if rng.random() < 0.4 else rng.uniform(2.0, 3.5))
    gap = 0.0 if rng.random() < 0.6 else float(rng.uniform(0.0, 2.0))
    level = LEVELS[str(rng.choice(list(LEVEL_SHARE), p=list(LEVEL_SHARE.values())))]
    timed = rng.random() < TIMED_SHARE
    interleave = int(rng.integers(1, 4))
    order_known = rng.random() < 0.5
    planned = rng.random() < PLANNED_SHARE
    turned = Rotation.random(random_state=rng) if not planned and rng.random() < 0.5 else None
    axes = rng.permutation(3)
    header, true, rank, stack_id = [], [], [], []
    for stack in range(n_stacks):
        if planned or turned is not None:
            plan = _planned_rotation(int(axes[stack % 3]), rng)
            rotation = plan if turned is None else turned.as_matrix() @ plan
        else:
            rotation = Rotation.random(random_state=rng).as_matrix()
        depth = corners @ rotation[:, 2]
        low, high = depth.min() - 5, depth.max() + 5
        if rng.random() < 0.12:  # a stack that does not cover the head
            cut = rng.uniform(0.1, 0.35) * (high - low)
            low, high = (low + cut, high) if rng.random() < 0.5 else (low, high - cut)
        step = thickness + gap
        z = np.arange(low + rng.uniform(0, step), high, step)
        center = rotation @ np.stack([np.full(len(z), 0.0), np.full(len(z), 0.0), z])
        pose = RigidPose(np.broadcast_to(rotation, (len(z), 3, 3)), center.T)
        if timed:
            motion = timed_trajectory(len(z), rng.uniform(0.8, 2.5), np.zeros(3), interleave, rng, recorded)
            turn = np.deg2rad(rng.normal(0, rng.uniform(0, TIMED_OFFSET_DEG), 3))
            motion = motion @ RigidPose.from_rotvec(turn[None], rng.normal(0, TIMED_OFFSET_MM, (1, 3)))
        else:
            motion = slice_trajectory(len(z), level, np.zeros(3), interleave, rng)
        in_time = np.empty(len(z))
        in_time[acquisition_order(len(z), interleave)] = np.arange(len(z)) / max(len(z) - 1, 1)
        header.append(pose)
        true.append(motion @ pose)
        rank.append(in_time if order_known else np.full(len(z), np.nan))
        stack_id.append(np.full(len(z), stack))
    joined = [
        RigidPose(np.concatenate([p.rotation for p in many]), np.concatenate([p.translation_mm for p in many]))
        for many in (header, true)
    ]
    n = len(joined[0])
    return joined[0], joined[1], np.full(n, thickness), np.concatenate(rank), np.concatenate(stack_id)


def _planned_rotation(axis: int, rng: np.random.Generator) -> Array:
    """Columns x, y, normal of a stack on a head's axis: tilted a little, turned and flipped at random."""
    normal = np.roll([1.0, 0.0, 0.0], axis) * rng.choice([-1.0, 1.0])
    x = np.roll(normal, 1)
    base = np.stack([x, np.cross(normal, x), normal], axis=1)
    tilt = Rotation.from_rotvec(rng.normal(0, PLAN_TILT_DEG, 3), degrees=True).as_matrix()
    turn = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    return tilt @ base @ turn


def _thinned(kept: NDArray[np.int64], max_slices: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """At most so many slices: every other one, or every third, and a few more left out at random."""
    if len(kept) > max_slices:
        stride = len(kept) // max_slices
        kept = kept[int(rng.integers(stride)) :: stride]
    if len(kept) > max_slices:
        kept = np.sort(rng.permutation(kept)[:max_slices])
    return kept


def _shift_to_centroid(
    look: NDArray[np.float32], area: Array, header: RigidPose, stack_id: NDArray[np.int64], pixel_mm: float
) -> Array:
    """From each slice's centre to its stack's centroid by the header, in the slice's own axes [K, 3] (mm)."""
    size = look.shape[1]
    at = (np.arange(size) - (size - 1) / 2) * pixel_mm
    weight = np.maximum(look.sum((1, 2)), 1e-6)
    middle = np.stack([look.sum(2) @ at / weight, look.sum(1) @ at / weight, np.zeros(len(look))], axis=1)
    world = header.apply(middle)
    total = np.bincount(stack_id, area)
    centroid = np.stack([np.bincount(stack_id, area * world[:, a]) / total for a in range(3)], axis=1)
    return header.inverse().apply(centroid[stack_id])


def _random_shape(rng: np.random.Generator) -> Array:
    """A linear map near the identity: size 10 %, each axis 4 %, sometimes mirrored left to right."""
    stretch = np.exp(rng.uniform(-0.1, 0.1) + rng.normal(0, 0.04, 3).clip(-0.08, 0.08))
    stretch[0] *= rng.choice([-1.0, 1.0])
    return np.diag(stretch)


def _homogeneous(linear: NDArray[np.floating]) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    return matrix


def _random_intensities(
    image: NDArray[np.float32], inside: NDArray[np.float32], pose: RigidPose, pixel_mm: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Gamma, gain per slice, shading, voids and Rician noise."""
    n, size = len(image), image.shape[1]
    image = image ** np.float32(np.exp(rng.uniform(-0.4, 0.4)))
    slope = (rng.normal(0, 0.1, 3) / 50.0) @ pose.rotation  # [K, 3] per mm along each slice's axes
    at = (np.arange(size) - (size - 1) / 2) * pixel_mm
    log_gain = rng.normal(0, rng.uniform(0, 0.1), n)
    dropout = rng.random(n) < 0.03
    log_gain = np.where(dropout, np.log(rng.uniform(0.1, 0.7, n)), log_gain)
    field = np.exp(
        log_gain[:, None, None] + slope[:, 0, None, None] * at[:, None] + slope[:, 1, None, None] * at
    ).astype(np.float32)
    sigma = np.float32(rng.uniform(0.0, 0.06))
    noise = rng.standard_normal((2, *image.shape), dtype=np.float32) * sigma
    return np.hypot(image * field + noise[0], noise[1]) * inside
