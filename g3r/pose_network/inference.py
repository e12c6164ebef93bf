"""Slice poses in the atlas frame from a trained pose network."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from g3r.acquisition.slice_images import SliceImages, batch_arrays
from g3r.geometry import RigidPose
from g3r.geometry.rigid import orthonormal
from g3r.pose_network.network import PoseNetwork, SliceBatch

N_REFINEMENTS = 2
VIEWS = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))
"""Rotations by 180 degrees, as diagonals: the four choices of a slice's own axes that keep its pixels.

The network sees all four and the results are averaged, which takes a fifth off the error.
"""
VIEW_SCALE_MM = 3.0
"""Views further than this from the mean are down-weighted in inverse proportion to their distance."""
ROTATION_ARM_MM = 25.0
"""Distance from a slice's centre at which a rotation is measured in mm."""
ROBUST_STEPS = 12


def poses_of(network: PoseNetwork, batch: SliceBatch) -> RigidPose:
    """Poses of the images of a batch in the atlas frame, averaged over four views of every slice."""
    rotation, translation = [], []
    for view in VIEWS:
        turn = torch.diag(torch.tensor(view, dtype=batch["image"].dtype, device=batch["image"].device))
        seen = dict(batch)
        seen["image"] = batch["image"].flip([2 + axis for axis in (0, 1) if view[axis] < 0])
        seen["header_rotation"] = batch["header_rotation"] @ turn
        seen["position_mm"] = batch["position_mm"] * view[2]
        with torch.no_grad():
            last = network(seen, N_REFINEMENTS)[-1]
        rotation.append((last.rotation @ turn).double().cpu().numpy())
        translation.append(last.translation_mm.double().cpu().numpy())
    return mean_pose(np.stack(rotation), np.stack(translation))


def mean_pose(rotation: NDArray[np.float64], translation_mm: NDArray[np.float64]) -> RigidPose:
    """The robust mean pose [K] of several estimates [V, K, 3, 3], [V, K, 3]; distant ones count little."""
    weight = np.ones(rotation.shape[:2])
    for _ in range(ROBUST_STEPS):
        share = (weight / weight.sum(0))[..., None]
        mean_rotation = orthonormal((share[..., None] * rotation).sum(0))
        mean_translation = (share * translation_mm).sum(0)
        turned = np.linalg.norm(rotation - mean_rotation, axis=(2, 3)) / np.sqrt(2) * ROTATION_ARM_MM
        off = turned + np.linalg.norm(translation_mm - mean_translation, axis=2)
        weight = 1 / np.maximum(off, VIEW_SCALE_MM)
    return RigidPose(mean_rotation, mean_translation)


def slice_batch(sets: Sequence[SliceImages]) -> SliceBatch:
    """The slices of several heads as one dict of tensors; stacks are numbered across all heads."""
    return {name: torch.from_numpy(value) for name, value in batch_arrays(sets).items()}


def as_pose(rotation: torch.Tensor, translation_mm: torch.Tensor) -> RigidPose:
    """Rigid poses in float64 from a network's float32 motions."""
    return RigidPose(orthonormal(rotation.double().cpu().numpy()), translation_mm.double().cpu().numpy())
