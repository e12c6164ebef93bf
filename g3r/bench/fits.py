"""Fits inside this process: one registration shared by many settings, and quality during a fit."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from g3r.acquisition.planes import Slices
from g3r.bench.scores import Quality, cloud_psnr_db, quality
from g3r.evaluation.case import SimulatedCase, pose_table
from g3r.fitting.observer import FitMoment
from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose
from g3r.planning.presets import ReconstructionSettings, changed
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration

SAMPLES_PER_FIT = 10

SPACING_FACTORS = (2.0, 1.4, 1.2, 1.0, 0.85)
STEP_FACTORS = (0.125, 0.25, 0.5, 1.0, 2.0)
CUTOFFS_SIGMA = (2.0, 2.4, 2.8, 3.2, 4.0)
RESOLUTIONS_MM = (0.6, 0.8, 1.0, 1.3, 1.6)


def sweeps(base: ReconstructionSettings) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Sweeps of one setting at a time: sweep, label, change of the settings (see `g3r.planning.presets.changed`)."""
    prior_steps, slice_steps = base.prior_stage.n_steps, base.slice_stage.n_steps
    return {
        "Gaussians": {
            f"spacing x {factor:g}": {
                "gaussian_spacing_pixels": factor * base.gaussian_spacing_pixels,
                "max_gaussian_spacing_mm": factor * base.max_gaussian_spacing_mm,
            }
            for factor in SPACING_FACTORS
        },
        "iterations": {
            f"{round(factor * prior_steps)} + {round(factor * slice_steps)}": {
                "prior_stage.n_steps": max(1, round(factor * prior_steps)),
                "slice_stage.n_steps": max(1, round(factor * slice_steps)),
            }
            for factor in STEP_FACTORS
        },
        "cut-off": {
            f"{sigma:g} sigma": {"prior_stage.cutoff_sigma": sigma, "slice_stage.cutoff_sigma": sigma}
            for sigma in CUTOFFS_SIGMA
        },
        "resolution": {f"{voxel:g} mm": {"resolution_mm": voxel} for voxel in RESOLUTIONS_MM},
    }


class FitWatch:
    """Keeps cloud and poses at intervals, with the seconds of the fit minus those spent here.

    Args:
        n_steps: number of steps of the fit.
        n_samples: number of samples to keep.
    """

    def __init__(self, n_steps: int, n_samples: int = SAMPLES_PER_FIT) -> None:
        self.every = max(1, n_steps // n_samples)
        self.step: list[int] = []
        self.seconds: list[float] = []
        self.cloud: list[GaussianCloud] = []
        self.pose: list[RigidPose] = []
        self.spent = 0.0

    def __call__(self, moment: FitMoment) -> None:
        """Keep a copy of a moment of the fit to the slices."""
        if moment.slices is None:
            return
        now = time.perf_counter()
        self.step.append(moment.step)
        self.seconds.append(now - self.spent)
        self.cloud.append(moment.cloud())
        self.pose.append(moment.slices.pose(moment.parameters.origin_mm))
        self.spent += time.perf_counter() - now

    def seconds_before_end(self) -> list[float]:
        """Seconds between each sample and the last one."""
        return [self.seconds[-1] - moment for moment in self.seconds]


def shared_registration(case: SimulatedCase, settings: ReconstructionSettings) -> Registration:
    """Poses of a subject's slices, for several fits."""
    return GaussianReconstructor(settings=settings).register_stacks(case.stacks)


def measured_fit(
    case: SimulatedCase, settings: ReconstructionSettings, motion: Registration | None = None
) -> dict[str, Any]:
    """One reconstruction: seconds by stage, number of Gaussians, quality, and quality during the fit.

    Args:
        case: simulated subject.
        settings: settings of the reconstruction, with a fit to the slices.
        motion: from `shared_registration`; None registers in this run.

    Returns:
        `seconds`, `cpu_seconds` (sums over the stages), `stages`, `stages_cpu`, `n_gaussians`, `psnr_db`,
        `ssim`, `tre_mm`, and `curve`: `step`, `seconds_before_end`, `psnr_db`.
    """
    watch = FitWatch(settings.slice_stage.n_steps)
    result = GaussianReconstructor(settings=settings, observer=watch).reconstruct(case.stacks, motion)
    found = quality(case, result.volume, result.grid.affine, pose_table(result.slices))
    stages = dict(result.record.seconds)
    stages["fit to slices"] = round(stages["fit to slices"] - watch.spent, 3)
    return {
        "seconds": round(sum(stages.values()), 3),
        "cpu_seconds": round(sum(result.record.cpu_seconds.values()), 3),
        "stages": stages,
        "stages_cpu": dict(result.record.cpu_seconds),
        "n_gaussians": len(result.cloud),
        **found.record(),
        "curve": _curve(case, watch, result.slices, found, settings.slice_stage.cutoff_sigma),
    }


def measured_sweeps(case: SimulatedCase, settings: ReconstructionSettings) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Every sweep around some settings, on one registration; the unchanged settings are fitted once.

    Yields:
        Sweep, label, and figures of `measured_fit` with `same_as_base`, which is True for unchanged settings.
    """
    motion = shared_registration(case, settings)
    base = measured_fit(case, settings, motion)
    for name, variants in sweeps(settings).items():
        for label, changes in variants.items():
            chosen = changed(settings, changes)
            same = chosen == settings
            figures = base if same else measured_fit(case, chosen, motion)
            yield name, label, {**figures, "same_as_base": same}


def _curve(
    case: SimulatedCase, watch: FitWatch, slices: Slices, found: Quality, cutoff_sigma: float
) -> dict[str, list[float]]:
    psnr = [
        cloud_psnr_db(case, cloud, pose_table(slices.with_pose(pose)), found.remaining, cutoff_sigma)
        for cloud, pose in zip(watch.cloud, watch.pose, strict=True)
    ]
    return {
        "step": list(watch.step),
        "seconds_before_end": [round(seconds, 3) for seconds in watch.seconds_before_end()],
        "psnr_db": [round(value, 3) for value in psnr],
    }
