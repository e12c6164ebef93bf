"""Error of estimated slice poses: target registration error (TRE) after one common motion is removed."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import load_volume
from g3r.acquisition.thinning import thinned
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid_robust

POSE_COLUMNS = ("rx", "ry", "rz", "tx", "ty", "tz")

MIN_PIXELS = 30
"""Slices with fewer mask pixels are not scored, because they show no anatomy by which a method could place them."""

POINTS_PER_SLICE = 128

ROBUST_SCALE_MM = 2.0
"""Cauchy scale of the fit of the common motion, which a few gross errors must not tilt."""

SliceKey = tuple[int, int]
"""Stack number and slice index along the third axis of the stack's file."""


@dataclass(frozen=True)
class PoseTable:
    """Slice poses as in files: a point at x by the header of the stack is estimated to be at R x + t."""

    keys: tuple[SliceKey, ...]
    pose: RigidPose


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """Target registration error over slices (mm), each slice the mean over its points.

    Attributes:
        mean_mm, median_mm, p90_mm: over the compared slices.
        n_slices: number of compared slices.
        n_missing: slices with brain in them that have no estimate.
        per_slice_mm: error of each slice.
        common: the motion that was removed, one pose; takes the frame of the estimate to that of the truth.
    """

    mean_mm: float
    median_mm: float
    p90_mm: float
    n_slices: int
    n_missing: int
    per_slice_mm: Mapping[SliceKey, float]
    common: RigidPose

    def figures(self) -> dict[str, float]:
        """The figures over all slices, for a record."""
        return {
            "mean_mm": self.mean_mm,
            "median_mm": self.median_mm,
            "p90_mm": self.p90_mm,
            "n_slices": self.n_slices,
            "n_missing": self.n_missing,
        }


def read_poses(path: str | os.PathLike[str]) -> PoseTable:
    """Read a table of slice poses (`slices.tsv`, `poses.tsv`): stack slice rx ry rz tx ty tz (rad, mm).

    Raises:
        InputError: the file does not exist, a column is missing, a value is not a number, or a slice is listed twice.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a table of slice poses (.tsv)")
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream, delimiter="\t"))
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path.name}: is not a text table; expected tab-separated slice poses") from None
    missing = [c for c in ("stack", "slice", *POSE_COLUMNS) if not rows or c not in rows[0]]
    if missing:
        raise InputError(f"{path.name}: has no column {', '.join(missing)}; expected a tab-separated pose table")
    try:
        keys = tuple((int(row["stack"]), int(row["slice"])) for row in rows)
        values = np.array([[float(row[c]) for c in POSE_COLUMNS] for row in rows])
        pose = RigidPose.from_rotvec(values[:, :3], values[:, 3:])
    except (TypeError, ValueError) as error:
        raise InputError(f"{path.name}: a pose cannot be read ({error}); expected finite numbers") from None
    if len(set(keys)) < len(keys):
        raise InputError(f"{path.name}: names a slice twice; expected one row per slice")
    return PoseTable(keys, pose)


def slice_points(mask_paths: Iterable[str | os.PathLike[str]]) -> dict[SliceKey, NDArray[np.float64]]:
    """Brain points, placed by the headers: up to 128 points [n, 3] (mm) of each slice with enough mask."""
    points: dict[SliceKey, NDArray[np.float64]] = {}
    for stack, path in enumerate(mask_paths):
        mask = load_volume(path)
        inside = np.nan_to_num(mask.data) > 0.5
        for k in np.flatnonzero(inside.sum((0, 1)) >= MIN_PIXELS):
            index = np.argwhere(inside[:, :, k])
            index = index[thinned(len(index), POINTS_PER_SLICE)]
            points[stack, int(k)] = mask.grid.world(np.c_[index, np.full(len(index), k)])
    return points


def target_registration_error(
    points_mm: Mapping[SliceKey, NDArray[np.float64]], true: PoseTable, estimated: PoseTable
) -> PoseError:
    """Distance between the true and the estimated positions of slices, up to one common rigid motion.

    Args:
        points_mm: points of each slice by the header, as `slice_points` gives them; slices without an entry
            here or without a true pose are not scored.
        true: the poses of the simulation.
        estimated: the poses to score.

    Raises:
        InputError: no slice is in all three.
    """
    true_row = {key: n for n, key in enumerate(true.keys)}
    estimated_row = {key: n for n, key in enumerate(estimated.keys)}
    scored = [key for key in points_mm if key in true_row]
    keys = [key for key in scored if key in estimated_row]
    if not keys:
        raise InputError("pose tables have no slice in common; check that they belong to the same stacks")
    count = [len(points_mm[key]) for key in keys]
    header = np.concatenate([points_mm[key] for key in keys])
    owner = np.repeat(np.arange(len(keys)), count)
    target = _place(header, true.pose.take([true_row[key] for key in keys]), owner)
    found = _place(header, estimated.pose.take([estimated_row[key] for key in keys]), owner)
    common, distance = fit_rigid_robust(found, target, scale_mm=ROBUST_SCALE_MM, n_rounds=10)
    per_slice = np.bincount(owner, distance) / np.bincount(owner)
    return PoseError(
        mean_mm=float(per_slice.mean()),
        median_mm=float(np.median(per_slice)),
        p90_mm=float(np.percentile(per_slice, 90)),
        n_slices=len(keys),
        n_missing=len(scored) - len(keys),
        per_slice_mm=dict(zip(keys, per_slice.tolist(), strict=True)),
        common=common,
    )


def _place(points_mm: NDArray[np.float64], pose: RigidPose, owner: NDArray[np.intp]) -> NDArray[np.float64]:
    """Move each point [P, 3] by the pose of the slice that owns it."""
    return np.einsum("pij,pj->pi", pose.rotation[owner], points_mm) + pose.translation_mm[owner]
