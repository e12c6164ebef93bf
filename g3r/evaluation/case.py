"""A simulated subject in a folder: stacks, the true volume, and the true pose of each slice."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume, load_mask, load_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack, load_stack
from g3r.errors import InputError
from g3r.evaluation.pose_error import (
    PoseError,
    PoseTable,
    SliceKey,
    read_poses,
    slice_points,
    target_registration_error,
)
from g3r.geometry import RigidPose


@dataclass(frozen=True, kw_only=True)
class SimulatedCase:
    """Content of a folder of `g3r-simulate` (`stack-N`, `mask-N`, `truth`, `truth-mask`, true poses).

    Attributes:
        name: name of the folder.
        folder: path of the folder.
        stacks: its stacks, in the order of their numbers.
        true: the true pose of every slice.
        points_mm: points of each slice, placed by its header, at which errors are measured.
    """

    name: str
    folder: Path
    stacks: tuple[Stack, ...]
    true: PoseTable
    points_mm: dict[SliceKey, NDArray[np.float64]]

    @cached_property
    def truth(self) -> Volume:
        """The true volume, from which the stacks were simulated."""
        return load_volume(self.folder / "truth.nii.gz")

    @cached_property
    def truth_mask(self) -> NDArray[np.bool_]:
        """The mask of the true volume."""
        return load_mask(self.folder / "truth-mask.nii.gz", self.truth)

    def pose_error(self, slices: Slices) -> PoseError:
        """Error of the current poses of slices of these stacks."""
        return target_registration_error(self.points_mm, self.true, pose_table(slices))


def load_case(folder: str | os.PathLike[str], thickness_mm: float | None = None) -> SimulatedCase:
    """Read a simulated subject.

    Args:
        folder: see `SimulatedCase`.
        thickness_mm: slice thickness; None takes that of `simulation.json`, or else the slice spacing.

    Raises:
        InputError: the folder holds no stacks or no true poses, or a file cannot be used.
    """
    folder = Path(folder)
    paths = sorted(folder.glob("stack-*.nii.gz"), key=lambda path: int(path.name.split("-")[1].split(".")[0]))
    if not paths:
        raise InputError(f"{folder}: no stack-N.nii.gz; expected the output folder of g3r-simulate")
    masks = [path.with_name(path.name.replace("stack-", "mask-")) for path in paths]
    if thickness_mm is None:
        thickness_mm = _recorded_thickness_mm(folder)
    stacks = tuple(load_stack(path, mask, thickness_mm) for path, mask in zip(paths, masks, strict=True))
    return SimulatedCase(
        name=folder.name, folder=folder, stacks=stacks, true=read_true_poses(folder), points_mm=slice_points(masks)
    )


def read_true_poses(folder: str | os.PathLike[str]) -> PoseTable:
    """The true poses of a simulated subject, from `poses.tsv` or else `poses.json`.

    `poses.json` is a list of `stack`, `slice`, `rotation` [3, 3] and `center` [3]: the point (x, y) mm from
    the middle of a slice's pixel grid, along the file's first two axes, is truly at
    rotation (x, y, 0) + center.

    Raises:
        InputError: neither file exists, or one cannot be read.
    """
    folder = Path(folder)
    if (folder / "poses.tsv").is_file():
        return read_poses(folder / "poses.tsv")
    path = folder / "poses.json"
    if not path.is_file():
        raise InputError(f"{folder}: neither poses.tsv nor poses.json; expected the true poses of the slices")
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        keys = tuple((int(row["stack"]), int(row["slice"])) for row in rows)
        true_frame = np.array([row["rotation"] for row in rows], dtype=np.float64).reshape(-1, 3, 3)
        true_center = np.array([row["center"] for row in rows], dtype=np.float64).reshape(-1, 3)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: a pose cannot be read ({error}); expected rotation and center") from None
    grids = {n: load_volume(folder / f"mask-{n}.nii.gz").grid for n in {stack for stack, _ in keys}}
    frames = {n: grid.axes for n, grid in grids.items()}
    # frames may be left-handed, but the motion between two frames of the same hand is still proper
    rotation = np.stack([r @ frames[key[0]].T for key, r in zip(keys, true_frame, strict=True)])
    middle = np.stack(
        [grids[n].world([(grids[n].shape[0] - 1) / 2, (grids[n].shape[1] - 1) / 2, float(k)]) for n, k in keys]
    )
    return PoseTable(keys, RigidPose(rotation, true_center - np.einsum("kij,kj->ki", rotation, middle)))


def pose_table(slices: Slices) -> PoseTable:
    """The current poses of slices, as a table."""
    keys = tuple(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
    return PoseTable(keys, slices.world_from_header())


def _recorded_thickness_mm(folder: Path) -> float | None:
    path = folder / "simulation.json"
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        value = record.get("thickness_mm", record.get("thickness"))
        return None if value is None else float(value)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); expected the record of g3r-simulate") from None
