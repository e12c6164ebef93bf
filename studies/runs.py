"""One subject through registration, or through the whole reconstruction, with errors, scores and seconds."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import Comparison, compare
from g3r.evaluation.metrics import Scores
from g3r.evaluation.pose_error import PoseError
from g3r.geometry import RigidPose, VolumeGrid
from g3r.planning.presets import PRESETS, ReconstructionSettings
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration
from g3r.registration.quality import pose_warnings, stack_qualities
from studies.subjects import read_case

BAD_MEDIAN_MM = 1.0
"""A subject whose median slice is further off than this counts as not registered."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """What one subject gave.

    Attributes:
        error: of the poses at the end.
        seconds: wall time of what was run.
        cpu_seconds: time of all threads.
        warnings: what g3r said against trusting the result.
        scores: of the volume; None where registration alone was run.
        stage_seconds: wall time of each stage of the reconstruction; empty where registration alone was run.
        orientation_deg: angle between the frame of the poses and that of the atlas, which the truth's voxel
            axes show.
    """

    error: PoseError
    seconds: float
    cpu_seconds: float
    warnings: tuple[str, ...]
    scores: Scores | None = None
    stage_seconds: Mapping[str, float] | None = None
    orientation_deg: float | None = None

    @property
    def is_bad(self) -> bool:
        """Whether the poses should not have been trusted."""
        return not self.error.median_mm < BAD_MEDIAN_MM

    def record(self) -> dict[str, Any]:
        """The figures as plain numbers, without the slices."""
        result: dict[str, Any] = {
            **self.error.figures(),
            "worst_mm": max(self.error.per_slice_mm.values()),
            "orientation_deg": self.orientation_deg,
            "seconds": round(self.seconds, 2),
            "cpu_seconds": round(self.cpu_seconds, 2),
            "warned": bool(self.warnings),
            "bad": self.is_bad,
            "warnings": list(self.warnings),
        }
        if self.scores:
            result |= {"psnr_db": self.scores.psnr_db, "ssim": self.scores.ssim}
            result |= {"stage_seconds": dict(self.stage_seconds or {})}
        return result


def registered(case: SimulatedCase, settings: ReconstructionSettings, checkpoint: str | None = None) -> Run:
    """Registration alone, as the reconstruction begins with it.

    Args:
        case: the subject.
        settings: of the reconstruction.
        checkpoint: of the prior; None takes the one shipped.
    """
    reconstructor = GaussianReconstructor(checkpoint, settings)
    wall, cpu = time.perf_counter(), time.process_time()
    motion = reconstructor.register_stacks(case.stacks)
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
    confidences = stack_qualities(motion, len(case.stacks))
    warnings = tuple(pose_warnings(motion, confidences, case.stacks))
    error = case.pose_error(motion.slices)
    return Run(
        error=error,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        warnings=warnings,
        orientation_deg=orientation_deg(case, error.common),
    )


def reconstructed(case: SimulatedCase, settings: ReconstructionSettings, checkpoint: str | None = None) -> Run:
    """The whole reconstruction, its volume scored after rigid alignment; arguments as of `registered`."""
    reconstructor = GaussianReconstructor(checkpoint, settings)
    wall, cpu = time.perf_counter(), time.process_time()
    result = reconstructor.reconstruct(case.stacks)
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
    error = case.pose_error(result.slices)
    return Run(
        error=error,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        warnings=tuple(result.record.warnings),
        scores=aligned(case, result.volume, result.grid, error.common).scores,
        stage_seconds=result.record.seconds,
        orientation_deg=orientation_deg(case, error.common),
    )


def aligned(
    case: SimulatedCase, data: NDArray[np.float32], grid: VolumeGrid, truth_from_volume: RigidPose
) -> Comparison:
    """A volume compared with the truth after rigid alignment.

    The volume may stand in another orientation than the truth, further than alignment reaches: the common
    motion of the slices brings it near first. `alignment` of the comparison starts from there.

    Args:
        case: with the truth.
        data: [I, J, K] of the volume.
        grid: of the data.
        truth_from_volume: the common motion of the slices (`PoseError.common`).
    """
    volume = Volume(data, grid.moved(truth_from_volume).affine, case.name)
    return compare(volume, case.truth, case.truth_mask, align=True)


def figures(scores: Scores) -> dict[str, float]:
    """What the tables show of scores, as plain numbers."""
    return {"psnr_db": round(scores.psnr_db, 4), "ssim": round(scores.ssim, 5)}


def orientation_deg(case: SimulatedCase, truth_from_result: RigidPose) -> float:
    """Angle between a result's frame and that of the atlas, which the voxel axes of the truth keep."""
    axes = case.truth.affine[:3, :3] / case.truth.grid.spacing_mm
    turn = RigidPose((axes.T @ truth_from_result.rotation[0])[None], np.zeros((1, 3)))
    return float(np.rad2deg(np.linalg.norm(turn.rotvec_rad())))


@functools.lru_cache(maxsize=1)
def registered_once(folder: Path, preset: str, checkpoint: str | None) -> Registration:
    """The registration that all fits of a case share.

    Args:
        folder: of the case.
        preset: its settings.
        checkpoint: of the prior; None takes the one shipped.
    """
    return GaussianReconstructor(checkpoint, PRESETS[preset]).register_stacks(read_case(folder).stacks)
