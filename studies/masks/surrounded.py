"""Simulated subjects, whose stacks are black around the brain, placed in the surroundings of the training scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import center_of_mass

from data_synth.atlas import TruthVolume
from data_synth.mask_head import SceneHead, filled_head, scene_head
from data_synth.mask_labels import Tissue, draw_intensities, textured
from data_synth.mask_slicing import image_slices
from data_synth.mask_surroundings import Surroundings, draw_surroundings
from g3r.acquisition.file_axes import AS_IN_FILE
from g3r.acquisition.stacks import Stack
from g3r.evaluation.case import SimulatedCase
from g3r.geometry import RigidPose, VolumeGrid

FIELD_OF_VIEW_MM = 280.0
"""Edge of the field of view in plane; real stacks of a uterus have 250 to 400 mm."""

SLICES_BEYOND = 4
"""Slices added at each end of a stack, because real stacks are planned to reach beyond the brain."""

N_THROUGH = 3

MAX_UNSEEN_MM2 = 100.0
"""Largest brain area in a slice without a masked pixel of the case. A slice with more brain stays black, because the
scene would show a hollow skull."""


def surrounded(case: SimulatedCase, seed: int) -> list[Stack]:
    """The stacks of a case with simulated surroundings in a larger field of view, and their true masks.

    Skull, scalp, face and neck move with the brain by the true poses. The mother does not move within a stack; she is
    placed by the pose of its middle slice.

    Args:
        case: black outside the masks.
        seed: of the surroundings and their contrast.
    """
    rng = np.random.default_rng(seed)
    grid = case.truth.grid
    middle_mm = grid.world(center_of_mass(case.truth_mask))
    affine = grid.affine.copy()
    affine[:3, 3] -= middle_mm
    bright = float(np.percentile(case.truth.data[case.truth_mask], 99.5))
    truth = TruthVolume(name=case.name, data=case.truth.data / bright, mask=case.truth_mask, affine=affine)
    head = scene_head(filled_head(truth), rng)
    around = draw_surroundings(head.base_mm, head.radius_mm, rng)
    mean, texture = draw_intensities(rng)
    shells = _without_brain(head, truth, mean, texture)
    behind = textured(around.labels, around.texture, mean, texture)
    own = np.zeros_like(shells)
    own[_box(head, truth)] = np.stack([truth.data * truth.mask, truth.mask, truth.mask], -1)
    return [_in_scene(case, n, middle_mm, head, (shells, own), around, behind) for n in range(len(case.stacks))]


def _box(head: SceneHead, truth: TruthVolume) -> tuple[slice, ...]:
    """The part of the head's grid that the truth covers."""
    offset = np.rint(VolumeGrid(head.labels.shape, head.affine).index(truth.affine[:3, 3])).astype(int)
    return tuple(slice(o, o + n) for o, n in zip(offset, truth.mask.shape, strict=True))


def _without_brain(
    head: SceneHead, truth: TruthVolume, mean: NDArray[np.float32], texture: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The head's channels (see `image_slices`), black where the case shows the brain."""
    brain = np.zeros(head.labels.shape, bool)
    brain[_box(head, truth)] = truth.mask
    shells = np.zeros((*head.labels.shape, 3), np.float32)
    fluid = np.where(head.labels == Tissue.BRAIN, Tissue.CSF, head.labels)  # clefts of the truth's mask
    shells[..., 0] = np.where(brain, 0, textured(fluid, head.texture, mean, texture))
    shells[..., 1] = head.labels > 0
    shells[..., 2] = brain
    return shells


def _in_scene(
    case: SimulatedCase,
    number: int,
    middle_mm: NDArray[np.float64],
    head: SceneHead,
    channels: tuple[NDArray[np.float32], NDArray[np.float32]],
    around: Surroundings,
    behind: NDArray[np.float32],
) -> Stack:
    """One stack with surroundings: the brain pixels of the case, and the scene around them with the gain of each slice.

    Where a slice of the case ends within the brain, it is continued by the truth. A slice of which the case shows
    nothing although it crosses the brain is black, since its content is unknown.

    Args:
        case: of the stack.
        number: of the stack.
        middle_mm: [3] centre of the brain in the truth's frame, the origin of the scene.
        head: gives the grid of the head's channels.
        channels: [I, J, K, 3] of the head without brain, and of the brain alone.
        around: gives the grid of the surroundings.
        behind: [N, N, N] intensities of the surroundings.
    """
    stack = _widened(case.stacks[number])
    n_slices = stack.image.shape[2]
    header = _slice_poses(stack)
    rows = [row for row, key in enumerate(case.true.keys) if key[0] == number]
    own = np.array([case.true.keys[row][1] for row in rows]) + SLICES_BEYOND
    nearest = np.abs(np.arange(n_slices)[:, None] - own).argmin(1)  # slices without brain have no true pose
    moved = case.true.pose.take(np.array(rows)[nearest])
    origin = RigidPose.from_rotvec(np.zeros((1, 3)), -middle_mm[None])
    head_pose = origin @ moved @ header
    scan_pose = origin @ moved.take(np.full(n_slices, n_slices // 2)) @ header
    pixel_mm = float(stack.spacing_mm[0])
    first = -(np.array(stack.image.shape[:2]) - 1) / 2 * pixel_mm

    def imaged(shown: NDArray[np.float32], scene: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        return image_slices(
            shown,
            np.linalg.inv(head.affine),
            head_pose,
            scene,
            np.linalg.inv(around.affine),
            scan_pose,
            first_mm=(float(first[0]), float(first[1])),
            pixel_mm=pixel_mm,
            shape=(stack.image.shape[0], stack.image.shape[1]),
            thickness_mm=stack.thickness_mm,
            n_through=N_THROUGH,
        )

    outside, brain = imaged(channels[0], behind)
    unseen = (brain.sum((0, 1)) * pixel_mm**2 > MAX_UNSEEN_MM2) & ~stack.mask.any((0, 1))
    outside[:, :, unseen] = 0
    truth, _ = imaged(channels[1], np.zeros_like(behind))
    gain = _gain(stack, truth)
    truth *= _beyond(case.stacks[number], stack)
    truth[:, :, unseen] = 0
    mask = stack.mask | ((truth > 0) & (brain > 0.5))
    return replace(stack, image=stack.image + gain * (truth + outside), mask=mask)


def _beyond(stack: Stack, widened: Stack) -> NDArray[np.bool_]:
    """Pixels of a widened stack that the stack does not have."""
    beyond = np.ones(widened.image.shape, bool)
    before = [(n - m) // 2 for n, m in zip(widened.image.shape, stack.image.shape, strict=True)]
    beyond[tuple(slice(b, b + n) for b, n in zip(before, stack.image.shape, strict=True))] = False
    return beyond


def _gain(stack: Stack, truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Gain [S] of the slices relative to the truth; the median gain for a slice without brain."""
    own, square = ((one * stack.mask).sum((0, 1)) for one in (stack.image * truth, truth**2))
    shows = square > 0
    gain = np.full(len(own), np.median(own[shows] / square[shows]))
    gain[shows] = own[shows] / square[shows]
    return gain.astype(np.float32)


def _widened(stack: Stack) -> Stack:
    """The stack padded with black to the field of view, and with black slices at both ends."""
    missing = np.maximum((FIELD_OF_VIEW_MM / stack.spacing_mm[:2] - stack.image.shape[:2]) / 2, 0).astype(int)
    pad = [(int(missing[0]),) * 2, (int(missing[1]),) * 2, (SLICES_BEYOND,) * 2]
    affine = stack.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ [float(before) for before, _ in pad]
    image, mask = np.pad(stack.image, pad), np.pad(stack.mask, pad)
    return replace(stack, image=image, mask=mask, affine=affine, file_affine=None, axes=AS_IN_FILE)


def _slice_poses(stack: Stack) -> RigidPose:
    """Slice poses by the header: the centre of each slice's pixel grid, and its axes."""
    n_i, n_j, n_slices = stack.image.shape
    index = np.stack([np.full(n_slices, (n_i - 1) / 2), np.full(n_slices, (n_j - 1) / 2), np.arange(n_slices)], axis=1)
    return RigidPose(np.broadcast_to(stack.grid.plane_frame, (n_slices, 3, 3)), stack.grid.world(index))
