"""A folder of slices with poses as input: stacks of a nominal geometry, and the motions that lead to the poses.

The fit needs stacks, to which bias fields, neighbours and missing slices belong. Each group of slices becomes a stack,
in a frame that is the robust mean of its poses, with slices shifted by whole pixels. The motions hold the rest, in
float64: composed with the geometry of the stack they give the poses of the headers.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.images import Volume, check_grid
from g3r.acquisition.slice_profile import ProfileOrigin
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.registration import GivenPoses
from g3r.registration.atlas_frame import motion_to_headers
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.slice_files import read_index, read_slices, slice_folder_of
from g3r.reuse.slice_groups import SliceGroup, grouped_by_headers, grouped_by_index, slope

REACH_MM = 60.0
"""Largest in-plane distance of the middle of a slice from that of its stack in the nominal geometry; the motions hold
the rest."""

MARGIN_MM = 10.0
"""In-plane margin around all slices of a stack. Slices are mostly cropped to the brain, so it holds none."""

TURN_SCALE_DEG = 5.0
"""Rotation against the mean of its stack at which a slice has half the weight in that mean."""

GAP_RANGE = (0.3, 4.0)
"""Accepted ratio of slice spacing to thickness; outside it slices are taken as gapless."""

N_ROUNDS = 15


@dataclass(frozen=True, kw_only=True)
class SliceFolder:
    """A folder of slices as stacks and poses.

    Attributes:
        folder: folder of the files.
        index_path: path of the index; None if slices were grouped by headers.
        groups: one per stack.
        stacks: stacks of nominal geometry.
        poses: poses of their slices.
    """

    folder: Path
    index_path: Path | None
    groups: list[SliceGroup]
    stacks: list[Stack]
    poses: GivenPoses

    @property
    def n_slices(self) -> int:
        """Number of slices in the folder."""
        return sum(len(group.files) for group in self.groups)


def read_slice_folder(
    path: str | os.PathLike[str], thickness_mm: Sequence[float] | None = None
) -> tuple[list[Stack], GivenPoses]:
    """Stacks and poses of a folder of slices, for `GaussianReconstructor.reconstruct`.

    `N.nii.gz` is a slice, one voxel thick, and `mask_N.nii.gz` its mask; without one, pixels above zero are used. The
    affine is the slice's pose and its third voxel size the thickness, as NeSVoR and `g3r-export-poses` write them.
    `index.tsv` beside them, or in the folder above, assigns slices to stacks; without it the headers do.

    Args:
        path: path of the folder, or of one that holds it as `slices`.
        thickness_mm: slice thickness, one for all or one per stack; None takes that of the headers.

    Raises:
        InputError: a folder or file cannot be used.
    """
    found = load_slice_folder(path, thickness_mm)
    return found.stacks, found.poses


def load_slice_folder(path: str | os.PathLike[str], thickness_mm: Sequence[float] | None = None) -> SliceFolder:
    """As `read_slice_folder`, with the groups of slices.

    Args:
        path: path of the folder, or of one that holds it as `slices`.
        thickness_mm: one for all or one per stack; None takes that of the headers.

    Raises:
        InputError: see `read_slice_folder`.
    """
    folder = slice_folder_of(path)
    files = read_slices(folder)
    if len(files) < 2:
        raise InputError(f"{folder}: holds a single slice, {files[0].path.name}; expected at least 2")
    index = read_index(folder)
    groups = grouped_by_index(files, index[1], index[0].name) if index else grouped_by_headers(files)
    if thickness_mm is not None and len(thickness_mm) not in (1, len(groups)):
        raise InputError(
            f"{len(thickness_mm)} thicknesses for {len(groups)} stacks ({_told(groups)}); give one, or one per stack"
        )
    given = [thickness_mm[n % len(thickness_mm)] if thickness_mm else None for n in range(len(groups))]
    kept = [n for n, group in enumerate(groups) if any(one.mask.any() for one in group.files)]
    if not kept:
        raise InputError(f"{folder}: no slice shows brain (all masks are empty); expected masks that mark it with 1")
    notes = _notes(groups, index is not None) + [
        f"{groups[n].name}: left out, all its masks are empty" for n in range(len(groups)) if n not in kept
    ]
    groups = [groups[n] for n in kept]
    placed = [_placed(group, given[n]) for n, group in zip(kept, groups, strict=True)]
    stacks, poses = _centred([stack for stack, _ in placed], [motion for _, motion in placed], groups)
    return SliceFolder(
        folder=folder,
        index_path=index[0] if index else None,
        groups=groups,
        stacks=stacks,
        poses=replace(poses, notes=tuple(notes)),
    )


def images_of_run(run: FinishedRun, path: str | os.PathLike[str]) -> list[NDArray[np.float32]]:
    """Images [I, J, K] of the stacks that a run made from a folder of slices.

    Args:
        run: a run of these slices.
        path: path of the folder.

    Raises:
        InputError: see `read_slice_folder`, or the run was made from other slices.
    """
    stacks, _ = read_slice_folder(path)
    if [stack.name for stack in stacks] != run.stack_names:
        raise InputError(
            f"{path}: holds {', '.join(stack.name for stack in stacks)}, the run was made of "
            f"{', '.join(run.stack_names)}; pass the folder of its --slices"
        )
    for stack, found in zip(stacks, run.geometry.stacks, strict=True):
        volume = Volume(stack.image, stack.affine, stack.name)
        check_grid(volume, found.in_file(), f"that of {stack.name} in the run", "slices")
    return [stack.image for stack in stacks]


def _notes(groups: Sequence[SliceGroup], indexed: bool) -> list[str]:
    by = "index.tsv" if indexed else "their headers"
    notes = [f"slices with given poses, grouped into stacks by {by}: {_told(groups)}"]
    files = [one for group in groups for one in group.files]
    if n_unmasked := sum(one.mask_path is None for one in files):
        notes.append(f"{n_unmasked} of {len(files)} slices have no mask: their pixels above zero are taken for brain")
    remarked = [one for one in files if one.remarks]
    if remarked:
        also = f" (and of {len(remarked) - 1} more slices)" if len(remarked) > 1 else ""
        notes.append(f"{remarked[0].path.name}: {remarked[0].remarks[0]}{also}")
    return notes


def _told(groups: Sequence[SliceGroup]) -> str:
    """Names of the stacks, with the numbers of their slices."""
    told = []
    for group in groups:
        numbers = sorted(one.number for one in group.files)
        whole = numbers == list(range(numbers[0], numbers[-1] + 1))
        count = f"{len(numbers)} slices" if len(numbers) > 1 else "1 slice"
        span = f"{numbers[0]}-{numbers[-1]}" if len(numbers) > 1 else f"{numbers[0]}"
        told.append(f"{group.name} of {count} ({span}{'' if whole else ', not all'})")
    return ", ".join(told)


def _placed(group: SliceGroup, thickness_mm: float | None) -> tuple[Stack, RigidPose]:
    """A stack for a group, and the motions [K] (world from header) that give its slices their poses.

    Args:
        group: K slices of a stack.
        thickness_mm: slice thickness; None takes that of the headers.

    Raises:
        InputError: as `Stack`.
    """
    files = group.files
    spacing = np.median([one.spacing_mm for one in files], axis=0)
    rotation = np.array([one.rotation for one in files])
    center = np.array([one.center_mm for one in files])
    frame = _mean_rotation(rotation)
    local = center @ frame
    gap = slope(local[:, 2], group.place)
    low, high = np.array(GAP_RANGE) * spacing[2]
    if not low <= abs(gap) <= high:
        gap = float(spacing[2]) * (-1 if gap < 0 else 1)
    start = float(np.median(local[:, 2] - gap * group.place))
    usual = np.median(local[:, :2], axis=0)
    middle = np.array([[(n - 1) / 2 for n in one.image.shape] for one in files])
    first = usual + np.clip(local[:, :2] - usual, -REACH_MM, REACH_MM) - middle * spacing[:2]
    origin = np.median(first, axis=0)
    offset = np.rint((first - origin) / spacing[:2]).astype(int)
    margin = np.ceil(MARGIN_MM / spacing[:2]).astype(int)
    lowest = offset.min(0) - margin
    shape = (offset + [one.image.shape for one in files]).max(0) + margin - lowest
    image = np.zeros((*shape, max(int(group.place[-1]) + 1, 2)), np.float32)
    mask = np.zeros(image.shape, bool)
    for one, (i, j), k in zip(files, offset - lowest, group.place, strict=True):
        n_i, n_j = one.image.shape
        image[i : i + n_i, j : j + n_j, k] = one.image
        mask[i : i + n_i, j : j + n_j, k] = one.mask
    affine = np.eye(4)
    affine[:3, :3] = frame * [*spacing[:2], gap]
    affine[:3, 3] = frame @ [*(origin + lowest * spacing[:2]), start]
    stack = Stack(
        image=image,
        mask=mask,
        affine=affine,
        thickness_mm=float(spacing[2]) if thickness_mm is None else thickness_mm,
        name=group.name,
        origin=ProfileOrigin(thickness_from="header" if thickness_mm is None else "option"),
        mask_source="file" if all(one.mask_path for one in files) else "empty background",
    )
    nominal_center = stack.grid.world(np.column_stack([offset - lowest + middle, group.place]))
    nominal = RigidPose(np.tile(frame, (len(files), 1, 1)), nominal_center)
    return stack, RigidPose(rotation, center) @ nominal.inverse()


def _mean_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The robust mean [3, 3] of rotations [K, 3, 3], on which a few strays have little influence."""
    each = Rotation.from_matrix(rotation)
    weight = np.ones(len(rotation))
    for _ in range(N_ROUNDS):
        mean = each.mean(weight)
        away = np.rad2deg((mean.inv() * each).magnitude())
        weight = 1 / (1 + (away / TURN_SCALE_DEG) ** 2)
    return np.asarray(mean.as_matrix(), np.float64)


def _centred(
    stacks: Sequence[Stack], motions: Sequence[RigidPose], groups: Sequence[SliceGroup]
) -> tuple[list[Stack], GivenPoses]:
    """Each stack moved to the robust mean of its slices, so that the mean of its motions is the identity.

    The common motion that a run records is then the motion from the frame of the files to that of the volume.
    """
    poses = GivenPoses(
        stack_id=np.repeat(np.arange(len(groups)), [len(group.files) for group in groups]),
        slice_index=np.concatenate([group.place for group in groups]),
        motion=RigidPose.concatenated(motions),
    )
    slices = slices_from_stacks(stacks)
    slices = slices.with_motion(poses.motion_of(slices))
    moved, corrected = [], []
    for n, (stack, motion) in enumerate(zip(stacks, motions, strict=True)):
        of_stack = slices.stack_id == n
        back = motion_to_headers(slices.take(of_stack)) if of_stack.any() else RigidPose.identity(1)
        moved.append(replace(stack, affine=stack.grid.moved(back.inverse()).affine))
        corrected.append(motion @ back)
    return moved, replace(poses, motion=RigidPose.concatenated(corrected))
