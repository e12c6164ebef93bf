"""Reconstruction of a head with an unseen part, and comparison of seen and unseen brain with the truth."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coverage import UNSEEN_BELOW, coverage
from g3r.acquisition.images import Volume
from g3r.acquisition.planes import Slices
from g3r.evaluation.align import resample
from g3r.evaluation.case import SimulatedCase
from g3r.geometry import RigidPose, VolumeGrid
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from studies.harness import Row
from studies.prior.volumes import slices_at_true_poses
from studies.runs import aligned
from studies.tables import Cell
from studies.unseen.fills import FILLS, filled_volumes

MIN_VOXELS = 100
"""Least number of voxels of a part of the brain that is scored."""


def measured(case: SimulatedCase, options: argparse.Namespace, *, true_poses: bool = False) -> Row:
    """Reconstruct a case, and score seen and unseen brain of every fill.

    Args:
        case: with the stacks to use.
        options: of the command; preset and prior are used.
        true_poses: whether to reconstruct from the true poses too, to measure the loss by wrong poses.
    """
    reconstructor = GaussianReconstructor(options.ckpt, PRESETS[options.preset])
    start = time.perf_counter()
    poses = reconstructor.register_stacks(case.stacks)
    result = reconstructor.reconstruct(case.stacks, poses)
    seconds = time.perf_counter() - start
    error = case.pose_error(result.slices)
    assert reconstructor.networks.prior is not None
    fills, made_of = filled_volumes(poses, reconstructor.networks.prior, reconstructor.networks.prior.voxel_mm)
    volumes: dict[str, tuple[NDArray[np.float32], VolumeGrid]] = {
        **{name: (values, made_of.grid) for name, values in fills.items()},
        "V_prior": (result.prior, result.prior_grid),
        "volume": (result.volume, result.grid),
    }
    unseen = truly_unseen(case)
    brain_mm3 = float(result.mask.sum()) * result.grid.voxel_volume_mm3
    true_mm3 = float(case.truth_mask.sum()) * case.truth.grid.voxel_volume_mm3
    registration = result.record.registration
    without_errors = {}
    if true_poses:
        best = reconstructor.reconstruct(case.stacks, at_true_poses(case, poses))
        common = case.pose_error(best.slices).common
        without_errors["at_true_poses"] = scored(case, best.volume, best.grid, common, unseen)
    return {
        **without_errors,
        "n_stacks": len(case.stacks),
        "unseen_share": float(unseen.sum()) / float(case.truth_mask.sum()),
        "stated_share": result.record.unseen.share if result.record.unseen else 0.0,
        **error.figures(),
        "volume_error": brain_mm3 / true_mm3 - 1,
        "scores": {name: scored(case, *volumes[name], error.common, unseen) for name in FILLS},
        "calibration": calibration_ratio(case, result, error.common),
        "warned": bool(result.record.warnings),
        "reliable": registration.reliable if registration else None,
        "seconds": round(seconds, 1),
    }


def at_true_poses(case: SimulatedCase, found: Registration) -> Registration:
    """A registration with the true poses of its slices, in the frame that it found; unknown poses are unchanged.

    Args:
        case: with the true poses.
        found: the registration of its stacks.
    """
    true = slices_at_true_poses(case, len(case.stacks))
    row = {key: n for n, key in enumerate(_keys(true))}
    known = [(n, row[key]) for n, key in enumerate(_keys(found.slices)) if key in row]
    here, there = (np.array(rows) for rows in zip(*known, strict=True))
    pose = case.pose_error(found.slices).common.inverse() @ true.planes.pose.take(there)
    return replace(found, slices=found.slices.with_pose(found.slices.planes.pose.with_rows(here, pose)))


def _keys(slices: Slices) -> list[tuple[int, int]]:
    return list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))


def truly_unseen(case: SimulatedCase) -> NDArray[np.bool_]:
    """Voxels of the true brain that no slice saw at its true pose."""
    density = coverage(slices_at_true_poses(case, len(case.stacks)), case.truth.grid)
    return case.truth_mask & (density < UNSEEN_BELOW)


def scored(
    case: SimulatedCase, values: NDArray[np.float32], grid: VolumeGrid, common: RigidPose, unseen: NDArray[np.bool_]
) -> dict[str, float]:
    """PSNR (dB) of the whole brain, of its seen and of its unseen part, after alignment and one gain and offset.

    Args:
        case: with the truth.
        values: [I, J, K] a volume.
        grid: its grid.
        common: motion of all slices to the truth.
        unseen: on the truth's grid.
    """
    alignment = aligned(case, values, grid, common).alignment
    assert alignment is not None
    volume = Volume(values, grid.moved(common).affine, "volume")
    moved = resample(volume, case.truth.grid, alignment.volume_from_reference)
    truth, brain = case.truth.data, case.truth_mask
    seen = brain & ~unseen
    design = np.stack([moved[seen], np.ones(int(seen.sum()))], axis=1)
    gain, offset = np.linalg.lstsq(design, truth[seen], rcond=None)[0]
    squared = (gain * moved + offset - truth) ** 2
    peak = float(np.percentile(truth[brain], 99.9))
    parts = {"whole": brain, "seen": seen, "unseen": unseen}
    return {
        name: round(float(10 * np.log10(peak**2 / squared[part].mean())), 3)
        for name, part in parts.items()
        if part.sum() > MIN_VOXELS
    }


def calibration_ratio(case: SimulatedCase, result: ReconstructionResult, common: RigidPose) -> dict[str, float]:
    """Ratio of stated to true mean error, in the seen and in the unseen part of the result.

    Args:
        case: with the truth.
        result: of the reconstruction.
        common: motion of all slices to the truth.
    """
    alignment = aligned(case, result.volume, result.grid, common).alignment
    assert alignment is not None
    assert result.uncertainty is not None
    truth_from_result = alignment.volume_from_reference.inverse() @ common
    truth = resample(case.truth, result.grid, truth_from_result)
    inside = Volume(case.truth_mask.astype(np.float32), case.truth.affine, "mask")
    both = result.mask & (resample(inside, result.grid, truth_from_result) > 0.5)
    seen = both & ~result.unseen
    factor = float(result.volume[seen].mean()) / float(truth[seen].mean())
    error = np.abs(result.volume - factor * truth)
    parts = {"seen": seen, "unseen": both & result.unseen}
    return {
        name: round(float(result.uncertainty[part].mean() / error[part].mean()), 3)
        for name, part in parts.items()
        if part.sum() > MIN_VOXELS
    }


def line(key: str, row: Row) -> str:
    """Progress line of a finished case."""
    unseen = ", ".join(f"{name} {row['scores'][name].get('unseen', float('nan')):.1f}" for name in FILLS)
    return (
        f"{key}: {row['unseen_share']:.1%} unseen, TRE {row['median_mm']:.2f} mm, brain {row['volume_error']:+.1%}, "
        f"whole {row['scores']['volume']['whole']:.2f} dB, unseen dB: {unseen}, {row['seconds']:.0f} s"
        f"{', warned' * row['warned']}"
    )


def _unseen(name: str) -> Cell:
    return lambda row: f"{row['scores'][name]['unseen']:.1f}" if "unseen" in row["scores"][name] else "-"


def _ratio(row: Row) -> str:
    return f"{row['calibration']['unseen']:.2f}" if "unseen" in row["calibration"] else "-"


EACH: dict[str, Cell] = {
    "case": "{name}",
    "unseen": "{unseen_share:.1%}",
    "stated": "{stated_share:.1%}",
    "TRE mm, median / p90": "{median_mm:.2f} / {p90_mm:.2f}",
    "brain volume": "{volume_error:+.1%}",
    **{f"{name}, unseen dB": _unseen(name) for name in FILLS},
    "whole dB": "{scores[volume][whole]:.2f}",
    "stated / true error": _ratio,
    "warned": lambda row: "yes" if row["warned"] else "-",
    "s": "{seconds:.0f}",
}
"""Columns of a table of cases."""
