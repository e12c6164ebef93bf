"""Registration or whole reconstruction of one subject, with errors, scores and seconds."""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.acquisition.planes import Slices
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import Comparison, compare
from g3r.evaluation.metrics import Scores
from g3r.evaluation.pose_error import PoseError, PoseTable, SliceKey, target_registration_error
from g3r.geometry import RigidPose, VolumeGrid
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from g3r.registration.open_strain import crossing_deg
from g3r.registration.quality import parallel_warnings, pose_warnings, stack_qualities
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW
from studies.harness import Row
from studies.subjects import read_case

BAD_MEDIAN_MM = 1.0
"""A subject counts as not registered if the median pose error of its slices is larger than this."""

OFF_MM, BAD_OFF_SHARE = 2.0, 0.05
"""A volume is unreliable if more than BAD_OFF_SHARE of the brain in its slices is misplaced by more than OFF_MM."""

NOTHING: Mapping[str, Any] = MappingProxyType({})


def header_error(case: SimulatedCase) -> PoseError:
    """Error of the header poses of a subject."""
    still = RigidPose.identity(len(case.true.keys))
    return target_registration_error(case.points_mm, case.true, PoseTable(case.true.keys, still))


def run(
    case: SimulatedCase, options: argparse.Namespace, changes: Mapping[str, Any] = NOTHING, *, full: bool
) -> tuple[PoseError, Row]:
    """Run registration alone, or the whole reconstruction and score its volume.

    Args:
        case: the subject.
        options: of the command; preset and prior are used.
        changes: of the settings (see `g3r.planning.presets.changed`).
        full: whether the whole reconstruction is run.

    Returns:
        Errors of the poses, and a row with the entries of `pose_row` and more: `off_share` and `crossing_deg` from the
        functions of these names, `orientation_deg` the angle between the frame of the poses and the atlas frame,
        `stage_seconds` the wall time of each stage of a reconstruction.
    """
    reconstructor = GaussianReconstructor(options.ckpt, changed(PRESETS[options.preset], changes))
    start = time.perf_counter(), time.process_time()
    result = reconstructor.reconstruct(case.stacks) if full else None
    motion = None if full else reconstructor.register_stacks(case.stacks)
    seconds = time.perf_counter() - start[0], time.process_time() - start[1]
    if result is not None:
        error, warnings = case.pose_error(result.slices), result.record.warnings
        slices, weight = result.slices, result.weight
        scores = aligned(case, result.volume, result.grid, error.common).scores
        more = {"psnr_db": scores.psnr_db, "ssim": scores.ssim, "stage_seconds": result.record.seconds}
    else:
        assert motion is not None
        warnings = pose_warnings(stack_qualities(motion, len(case.stacks)), case.stacks)
        warnings += parallel_warnings(motion.slices)
        slices, weight = motion.slices, motion.weight
        error, more = case.pose_error(slices), {}
    more["crossing_deg"] = crossing_deg(slices)
    more["off_share"] = round(off_share(error.per_slice_mm, slices, weight), 4)
    return error, pose_row(error, warnings, *seconds) | {"orientation_deg": orientation_deg(case, error.common)} | more


def pose_row(error: PoseError, warnings: Sequence[str], seconds: float, cpu_seconds: float) -> Row:
    """Summary figures of pose errors, without the errors of single slices.

    Args:
        error: of the poses.
        warnings: of g3r about the poses.
        seconds: wall time of the run.
        cpu_seconds: of all threads.
    """
    return {
        **error.figures(),
        "worst_mm": max(error.per_slice_mm.values()),
        "off_share": None,
        "orientation_deg": None,
        "seconds": round(seconds, 2),
        "cpu_seconds": round(cpu_seconds, 2),
        "warned": bool(warnings),
        "bad": not error.median_mm < BAD_MEDIAN_MM,
        "warnings": list(warnings),
    }


def off_share(error_mm: Mapping[SliceKey, float], slices: Slices, weight: NDArray[np.float64]) -> float:
    """Share of the brain misplaced by more than `OFF_MM`, among slices that are used and whose true pose is known.

    Args:
        error_mm: pose error of each slice whose true pose is known.
        slices: K slices.
        weight: [K] slice weights; slices with at least `DOWNWEIGHTED_BELOW` are used.
    """
    keys = list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
    area = np.bincount(slices.pixel_plane, minlength=len(keys)) * (weight >= DOWNWEIGHTED_BELOW)
    known = np.array([key in error_mm for key in keys])
    off = np.array([error_mm.get(key, 0.0) > OFF_MM for key in keys])
    return float(area[known & off].sum() / max(area[known].sum(), 1))


def aligned(
    case: SimulatedCase,
    data: NDArray[np.float32],
    grid: VolumeGrid,
    truth_from_volume: RigidPose,
    *,
    near: bool = False,
) -> Comparison:
    """A volume compared with the truth after rigid alignment.

    The orientations of volume and truth may differ too much for the alignment, so the common motion of the slices
    is applied first. `alignment` of the comparison is relative to it.

    Args:
        case: with the truth.
        data: [I, J, K] of the volume.
        grid: of the data.
        truth_from_volume: the common motion of the slices (`PoseError.common`).
        near: whether to rely on the common motion, which is faster for a volume unlike the truth (`align_rigid`).
    """
    volume = Volume(data, grid.moved(truth_from_volume).affine, case.name)
    return compare(volume, case.truth, case.truth_mask, align=True, near=near)


def figures(scores: Scores) -> dict[str, float]:
    """The scores shown in tables, as plain numbers."""
    return {"psnr_db": round(scores.psnr_db, 4), "ssim": round(scores.ssim, 5)}


def orientation_deg(case: SimulatedCase, truth_from_result: RigidPose) -> float:
    """Angle between a result's frame and the atlas frame, whose axes are the voxel axes of the truth."""
    turn = RigidPose((case.truth.grid.axes.T @ truth_from_result.rotation[0])[None], np.zeros((1, 3)))
    return float(np.rad2deg(np.linalg.norm(turn.rotvec_rad())))


@functools.lru_cache(maxsize=1)
def registered_once(folder: Path, preset: str, checkpoint: str | None) -> Registration:
    """The registration of a case, cached for all fits of it.

    Args:
        folder: of the case.
        preset: name of the settings.
        checkpoint: of the prior; None takes the shipped prior.
    """
    return GaussianReconstructor(checkpoint, PRESETS[preset]).register_stacks(read_case(folder).stacks)
