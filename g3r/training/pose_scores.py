"""Validation of the pose network's training: errors of slices and of stacks against the truth, and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid
from g3r.pose_network.geometry import moved_points, pixel_points_mm, sample_rows
from g3r.pose_network.inference import ROBUST_STEPS, as_pose
from g3r.pose_network.network import PoseNetwork, PoseStep

Batch = Mapping[str, Tensor]

RIGHT_WITHIN_DEG = 20.0

N_PANEL_SLICES = 12

SLICE_POINTS_MM = np.array([[0, 0, 0], [-25, -25, 0], [-25, 25, 0], [25, -25, 0], [25, 25, 0]], dtype=float)
"""Points of a slice over which a pose error is averaged."""
ROBUST_SCALE_MM = 3.0
"""Slices further than this from their stack's common motion are down-weighted in inverse proportion."""


def scores_of(first: RigidPose, last: RigidPose, batch: Batch) -> dict[str, np.ndarray]:
    """Errors (mm, degrees) of one head's slices after the first and the last step, and of its stacks.

    Args:
        first: [S] poses after the first step.
        last: [S] poses after the last step.
        batch: the slices of this one head; see `SliceSetDataModule`.

    Returns:
        [S] or [T] errors by name, for S slices in T stacks.
    """
    true = as_pose(batch["true_rotation"], batch["true_translation_mm"])
    stack = batch["stack"].cpu().numpy()
    rotation = batch["header_rotation"].double().cpu().numpy()
    header = as_pose(
        batch["header_rotation"],
        torch.from_numpy(rotation[:, :, 2] * batch["position_mm"].double().cpu().numpy()[:, None]),
    )
    fitted, ideal = stack_motions(last, header, stack), stack_motions(true, header, stack)
    middle = RigidPose(rotation[np.unique(stack, return_index=True)[1]], np.zeros((stack.max() + 1, 3)))
    slice_mm, slice_deg = pose_errors(last, true)
    stack_mm, stack_deg = pose_errors(fitted @ middle, ideal @ middle)
    return {
        "slice_mm": slice_mm,
        "slice_deg": slice_deg,
        "slice_mm_first": pose_errors(first, true)[0],
        "stack_mm": stack_mm,
        "stack_deg": stack_deg,
    }


def summary(scores: Sequence[Mapping[str, np.ndarray]]) -> dict[str, float]:
    """Medians over all heads, and of slices and stacks for each number of stacks."""
    result = {name: float(np.median(np.concatenate([s[name] for s in scores]))) for name in scores[0]}
    angles = np.concatenate([s["stack_deg"] for s in scores])
    result["stacks_within_20deg"] = float((angles <= RIGHT_WITHIN_DEG).mean())
    for n_stacks in sorted({len(s["stack_deg"]) for s in scores}):
        some = [s for s in scores if len(s["stack_deg"]) == n_stacks]
        for name in ("slice_mm", "slice_deg", "stack_mm", "stack_deg"):
            result[f"{name}_{n_stacks}"] = float(np.median(np.concatenate([s[name] for s in some])))
    return result


def panel(pose: PoseStep, batch: Batch, network: PoseNetwork) -> Tensor:
    """Picture of slices of the first head above the atlas template at their poses.

    Args:
        pose: rotations [S, 3, 3] and translations [S, 3] in mm.
        batch: has the slices.
        network: has the template.

    Returns:
        [H, W] in [0, 1].
    """
    rows = torch.linspace(0, len(batch["image"]) - 1, N_PANEL_SLICES).round().long().unique()
    image = batch["image"][rows, 0].float().cpu()
    points = pixel_points_mm(network.config.image_size, network.config.pixel_mm, pose[0])
    where = moved_points(pose[0][rows], pose[1][rows], points)
    heads = sample_rows(network.template, where, network.config.template_spacing_mm)
    shown = heads[..., heads.shape[-1] // 2].reshape(image.shape).float().cpu()
    return torch.cat([torch.cat(list(image), 1), torch.cat(list(shown), 1)], 0).clamp(0.0, 1.0)


def stack_motions(atlas_from_slice: RigidPose, world_from_slice: RigidPose, stack_id: NDArray[np.int64]) -> RigidPose:
    """One motion per stack, atlas frame from world, that most of its slices agree with.

    It starts from the motion of the slice that fits the others best in the median, so that a minority of upside-down
    slices has no effect. Weighted least squares with weights 1 / distance follow.

    Args:
        atlas_from_slice: predicted poses [K].
        world_from_slice: the headers' poses [K] of the same frames.
        stack_id: [K] 0, 1, ... without gaps.
    """
    points = np.broadcast_to(SLICE_POINTS_MM, (len(stack_id), *SLICE_POINTS_MM.shape))
    predicted, header = atlas_from_slice.apply(points), world_from_slice.apply(points)
    own = atlas_from_slice @ world_from_slice.inverse()
    rotation, translation = [], []
    for stack in range(int(stack_id.max()) + 1):
        rows = np.flatnonzero(stack_id == stack)
        source, target = header[rows], predicted[rows]
        candidates = own.take(rows)
        moved = candidates.apply(np.broadcast_to(source.reshape(-1, 3), (len(rows), source[..., 0].size, 3)))
        distance = np.linalg.norm(moved - target.reshape(-1, 3), axis=-1).reshape(len(rows), len(rows), -1)
        best = int(np.median(distance.mean(-1), axis=1).argmin())
        motion = candidates.take([best])
        for _ in range(ROBUST_STEPS):
            off = np.linalg.norm(motion.apply(source.reshape(1, -1, 3))[0] - target.reshape(-1, 3), axis=-1)
            weight = 1 / np.maximum(off.reshape(len(rows), -1).mean(1), ROBUST_SCALE_MM)
            motion = fit_rigid(source.reshape(-1, 3), target.reshape(-1, 3), np.repeat(weight, len(SLICE_POINTS_MM)))
        rotation.append(motion.rotation[0])
        translation.append(motion.translation_mm[0])
    return RigidPose(np.array(rotation), np.array(translation))


def pose_errors(predicted: RigidPose, true: RigidPose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean distance (mm) of five slice points, and angle (degrees), of each of K poses."""
    points = np.broadcast_to(SLICE_POINTS_MM, (len(true), *SLICE_POINTS_MM.shape))
    distance_mm = np.linalg.norm(predicted.apply(points) - true.apply(points), axis=-1).mean(1)
    return distance_mm, np.rad2deg(np.linalg.norm((predicted.inverse() @ true).rotvec_rad(), axis=1))
