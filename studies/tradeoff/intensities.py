"""`python -m studies.tradeoff.intensities`: errors of gains and bias fields of slices, and their effect on the volume.

Errors that all slices have in common do not show in the errors of single slices. They shade the volume, which is
measured with and without correction of the common bias field (N4).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from g3r.acquisition.images import Volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.evaluation.case import SimulatedCase, load_case
from g3r.evaluation.compare import compare
from g3r.evaluation.pose_error import SliceKey
from g3r.geometry import RigidPose
from g3r.mask_network.mask_shape import as_people_draw
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from studies.harness import FITS, Record, Row, Study, Task
from studies.masks.cases import EDGE_MM, SEED
from studies.masks.surrounded import SLICES_BEYOND, surrounded
from studies.subjects import THICKNESS_MM, data_folder
from studies.tables import Cell, table

CASES = ("sta24-severe", "sb28-mild-gap", "sb32-moderate", "sta30-moderate", "sta30-none", "sta34-single")

DEEP_MM = 4.0
"""Least depth in the brain of pixels that count; nearer to the edge, the slice profile dominates their intensity."""

MIN_PIXELS = 30
"""Least number of pixels of a slice for which an error is computed."""

SURPRISE = 0.3
"""Deviation of log-intensity from which pixels are down-weighted: noise, and edges in unexpected places."""

LENGTH_MM = 40.0
"""Unit of length in the linear fit to a slice."""

SHADING_MM = 10.0
"""Standard deviation of the Gaussian filter with which shading is measured."""

MASKS = ("as simulated", "in surroundings", "with a rim")


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case and kind of masks."""
    folders = sorted(path for path in data_folder("cases").iterdir() if path.is_dir())
    for number, folder in enumerate(folders):
        for masks in MASKS if folder.name in CASES else ():
            yield Task(f"{folder.name}, {masks}", measure, (folder, SEED + number, masks, options))


def measure(folder: Path, seed: int, masks: str, options: argparse.Namespace) -> Row:
    """Errors of gains from registration and after matching, and of the least-squares volumes with both.

    Args:
        folder: of the case.
        seed: of its surroundings.
        masks: one of `MASKS`.
        options: of the command.
    """
    case = load_case(folder, THICKNESS_MM.get(folder.name))
    stacks = stacks_with(case, seed, masks)
    reconstructor = GaussianReconstructor(options.ckpt, PRESETS[options.preset])
    registered = reconstructor.register_stacks(stacks)
    maker = reconstructor.networks.subject_prior(reconstructor.settings)
    matched, _ = maker.matched(registered)
    beyond = 0 if masks == MASKS[0] else SLICES_BEYOND
    expected = ExpectedPixels.of(case, registered.slices, beyond)
    row: Row = {"case": case.name, "masks": masks, "n_stacks": registered.slices.n_stacks}
    without_n4 = replace(maker, common_bias_field=False)
    for name, poses, made in (
        ("registered", registered, maker),
        ("matched", matched, maker),
        ("without_n4", matched, without_n4),
    ):
        volumes = made.volumes(poses)
        moved = replace(poses.slices, slice_index=poses.slices.slice_index - beyond)
        place = volumes.grid.moved(case.pose_error(moved).common)
        depth_mm = distance_transform_edt(case.truth_mask, sampling=case.truth.grid.spacing_mm)
        found = compare(Volume(volumes.sharp, place.affine, case.name), case.truth, depth_mm > EDGE_MM, align=True)
        row[name] = {
            "error": expected.error(poses),
            "inner_psnr_db": round(found.scores.psnr_db, 3),
            "shading": round(shading(found.volume, case.truth, depth_mm > DEEP_MM), 5),
        }
    return row


def shading(volume: NDArray[np.floating], truth: Volume, inside: NDArray[np.bool_]) -> float:
    """Standard deviation of the log of the smooth ratio of a volume to the truth, over voxels deep in the brain.

    Args:
        volume: [I, J, K] on the grid of the truth.
        truth: to compare with.
        inside: [I, J, K] voxels that count.
    """
    width = SHADING_MM / truth.grid.spacing_mm
    shared = gaussian_filter(np.where(inside, volume * truth.data, 0.0), width)
    own = gaussian_filter(np.where(inside, np.square(volume, dtype=np.float64), 0.0), width)
    return float(np.log(shared[inside] / own[inside]).std())


def stacks_with(case: SimulatedCase, seed: int, masks: str) -> Sequence[Stack]:
    """The stacks of a case with one of `MASKS`.

    Args:
        case: black outside its masks.
        seed: of its surroundings.
        masks: one of `MASKS`.
    """
    if masks == MASKS[0]:
        return case.stacks
    stacks = surrounded(case, seed)
    if masks == MASKS[1]:
        return stacks
    return [replace(stack, mask=as_people_draw(stack.mask, stack.spacing_mm)) for stack in stacks]


@dataclass(frozen=True, kw_only=True)
class ExpectedPixels:
    """Expected intensities of pixels deep in the brain, by the truth and with a gain of 1.

    Attributes:
        index: [P] numbers of the pixels.
        plane: [P] their slices.
        value: [P] expected intensities.
        uv: [P, 2] positions in the plane, in units of `LENGTH_MM`.
    """

    index: NDArray[np.int64]
    plane: NDArray[np.integer]
    value: NDArray[np.float64]
    uv: NDArray[np.float64]

    @classmethod
    def of(cls, case: SimulatedCase, slices: Slices, beyond: int) -> ExpectedPixels:
        """Pixels of slices that have a true pose.

        Args:
            case: with the truth.
            slices: of its stacks.
            beyond: number of slices that were added before the first slice of the case in each stack.
        """
        row_of: dict[SliceKey, int] = {key: row for row, key in enumerate(case.true.keys)}
        keys = zip(slices.stack_id.tolist(), (slices.slice_index - beyond).tolist(), strict=True)
        rows = np.array([row_of.get(key, -1) for key in keys])
        motion = RigidPose(case.true.pose.rotation[rows], case.true.pose.translation_mm[rows])
        planes = slices.with_motion(motion).planes
        index = slices.pixel_index[rows[slices.pixel_plane] >= 0]
        operator = VoxelOperator(planes, case.truth.grid, index, (3, 3, 7))
        depth_mm = distance_transform_edt(case.truth_mask, sampling=case.truth.grid.spacing_mm).astype(np.float32)
        value = operator.forward(np.where(case.truth_mask, case.truth.data, 0).astype(np.float32)).astype(np.float64)
        deep = operator.forward(depth_mm) > DEEP_MM
        deep &= value > 0.1 * value[deep].mean()
        uv = slices.planes.pixel_uv_mm(index[deep]) / LENGTH_MM
        return cls(index=index[deep], plane=operator.plane[deep], value=value[deep], uv=uv)

    def error(self, poses: Registration) -> float:
        """Root mean square, over these pixels, of the smooth part in each slice of log(measured / gain / expected)."""
        measured = poses.slices.value[self.index].astype(np.float64)
        off = np.log(np.maximum(measured, 1e-3 * measured.mean())) - np.log(poses.gain)[self.plane] - np.log(self.value)
        off = np.clip(off - np.median(off), -1, 1)
        weight = 1 / (1 + (off / SURPRISE) ** 2)
        smooth = np.full(len(off), np.nan)
        for plane in np.unique(self.plane):
            rows = np.flatnonzero(self.plane == plane)
            if len(rows) < MIN_PIXELS:
                continue
            terms = np.column_stack([np.ones(len(rows)), self.uv[rows] - self.uv[rows].mean(0)])
            ridge = 1e-3 * len(rows) * np.diag([0, 1, 1])
            weighted = weight[rows, None] * terms
            smooth[rows] = terms @ np.linalg.solve(terms.T @ weighted + ridge, weighted.T @ off[rows])
        smooth = smooth[np.isfinite(smooth)]
        return round(float(smooth.std()), 4)


def line(key: str, row: Row) -> str:
    """Progress line of a finished case."""
    before, after = row["registered"], row["matched"]
    return (
        f"{key}: error {before['error']:.3f} to {after['error']:.3f}, "
        f"V_sharp {before['inner_psnr_db']:.2f} to {after['inner_psnr_db']:.2f} dB"
    )


def tables(record: Record) -> dict[str, str]:
    """A row for each case and kind of masks."""
    columns: dict[str, Cell] = {
        "case": "{case}",
        "masks": "{masks}",
        "stacks": "{n_stacks}",
        "error as registered": lambda row: f"{row['registered']['error']:.1%}",
        "matched": lambda row: f"{row['matched']['error']:.1%}",
        "V_sharp as registered, dB": "{registered[inner_psnr_db]:.2f}",
        "matched, dB": "{matched[inner_psnr_db]:.2f}",
        "without N4, dB": "{without_n4[inner_psnr_db]:.2f}",
        "shading": lambda row: f"{row['matched']['shading']:.2%}",
        "without N4": lambda row: f"{row['without_n4']['shading']:.2%}",
    }
    return {"intensities": f"Preset `{record['preset']}`.\n\n{table(list(record['rows'].values()), columns)}"}


STUDY = Study(
    name="tradeoff.intensities",
    about="Gains and fields as registration finds them and as they are matched where slices cross, against the truth.",
    document="tradeoff.md",
    shared=FITS,
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
