"""One subject through registration, or through the whole reconstruction, with errors, scores and seconds."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from g3r._version import __version__
from g3r.acquisition.images import Volume
from g3r.acquisition.planes import slices_from_stacks
from g3r.errors import InputError
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import compare
from g3r.evaluation.metrics import Scores
from g3r.evaluation.pose_error import PoseError
from g3r.motion import estimate_motion
from g3r.presets import PRESETS, ReconstructionSettings
from g3r.reconstruct import GaussianReconstructor, _percentile_scale, _pose_warnings

BAD_MEDIAN_MM = 1.0
"""A subject whose median slice is further off than this counts as not registered."""


@dataclass(frozen=True)
class Run:
    """What one subject gave.

    Attributes:
        error: of the poses at the end.
        seconds: wall time of what was run.
        cpu_seconds: time of all threads.
        warnings: what g3r said against trusting the result.
        scores: of the volume; None where registration alone was run.
        stage_seconds: wall time of each stage of the reconstruction; empty where registration alone was run.
    """

    error: PoseError
    seconds: float
    cpu_seconds: float
    warnings: tuple[str, ...]
    scores: Scores | None = None
    stage_seconds: Mapping[str, float] | None = None

    @property
    def is_bad(self) -> bool:
        """Whether the poses should not have been trusted."""
        return not self.error.median_mm < BAD_MEDIAN_MM

    def record(self) -> dict[str, Any]:
        """The figures as plain numbers, without the slices."""
        error = {k: v for k, v in vars(self.error).items() if k != "per_slice_mm"}
        worst = max(self.error.per_slice_mm.values())
        result: dict[str, Any] = {
            **error, "worst_mm": worst,
            "seconds": round(self.seconds, 2), "cpu_seconds": round(self.cpu_seconds, 2),
            "warned": bool(self.warnings), "bad": self.is_bad, "warnings": list(self.warnings),
        }  # fmt: skip
        if self.scores:
            result |= {"psnr_db": self.scores.psnr_db, "ssim": self.scores.ssim}
            result |= {"stage_seconds": dict(self.stage_seconds or {})}
        return result


def registered(case: SimulatedCase, settings: ReconstructionSettings) -> Run:
    """Registration alone, as the reconstruction begins with it."""
    wall, cpu = time.perf_counter(), time.process_time()
    slices = slices_from_stacks(case.stacks)
    slices = slices.scaled(1 / _percentile_scale(slices))
    motion_settings = settings.motion
    if len(case.stacks) == 1:
        motion_settings = replace(motion_settings, stacks=False, n_rounds=0)
    motion = estimate_motion(slices, motion_settings)
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
    warnings = tuple(_pose_warnings(motion, case.stacks))
    return Run(case.pose_error(motion.slices), seconds, cpu_seconds, warnings)


def reconstructed(
    case: SimulatedCase, settings: ReconstructionSettings, checkpoint: str | None = None
) -> Run:
    """The whole reconstruction, its volume scored after rigid alignment."""
    reconstructor = GaussianReconstructor(checkpoint, settings)
    wall, cpu = time.perf_counter(), time.process_time()
    result = reconstructor.reconstruct(case.stacks)
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
    volume = Volume(result.volume, result.grid.affine, case.name)
    scores = compare(volume, case.truth, case.truth_mask, align=True).scores
    return Run(
        case.pose_error(result.slices), seconds, cpu_seconds, tuple(result.record["warnings"]), scores,
        result.record["seconds"],
    )  # fmt: skip


def preset_settings(name: str) -> ReconstructionSettings:
    """The settings of a preset.

    Raises:
        InputError: no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"--preset {name}; expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


def changed(settings: Any, options: Mapping[str, Any]) -> Any:
    """Settings with some fields replaced; `motion.n_rounds` names a field of a record inside.

    Raises:
        ValueError: no such field.
    """
    for path, value in options.items():
        name, _, rest = path.partition(".")
        if not is_dataclass(settings) or name not in {field.name for field in fields(settings)}:
            raise ValueError(f"{type(settings).__name__} has no field {name!r}")
        inner = changed(getattr(settings, name), {rest: value}) if rest else value
        settings = replace(settings, **{name: inner})  # type: ignore[type-var]
    return settings


def use_threads(n_threads: int) -> None:
    """Give both thread pools the same number, at most what the process was started with."""
    import numba
    import torch

    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(min(n_threads, most))
    torch.set_num_threads(min(n_threads, most))


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0))


def machine() -> dict[str, Any]:
    """What the seconds depend on."""
    return {
        "g3r": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cores": available_cores(),
    }
