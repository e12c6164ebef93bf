"""GaussianReconstructor: the pipeline from stacks to a volume, a screen of calls."""

from __future__ import annotations

import logging
import os
import platform
import resource
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from g3r._version import __version__
from g3r.acquisition.foreground import foreground_mask
from g3r.acquisition.planes import (
    SMALLEST_SLICE_PIXELS,
    Slices,
    slices_from_stacks,
    volume_from_pixels,
    volume_planes,
)
from g3r.acquisition.scatter import coarse_and_density, confidence, normalisation_scale
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError, NumericalError
from g3r.fitting.prior_stage import VolumeTarget, fit_prior
from g3r.fitting.slice_stage import SliceFit, fit_slices
from g3r.gaussians import render
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import VolumeGrid
from g3r.motion import MotionEstimate, estimate_motion
from g3r.motion.confidence import (
    StackConfidence,
    pose_warnings,
    registration_summary,
    stack_confidences,
)
from g3r.motion.volume import grid_around
from g3r.presets import PRESETS, ReconstructionSettings
from g3r.prior import PriorCheckpoint, estimate_prior, load_pose_network, load_prior, predict_poses
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.pose_checkpoint import PoseCheckpoint
from g3r.prior.pose_network import PoseNetwork
from g3r.result import ReconstructionResult

logger = logging.getLogger(__name__)

DEFAULT_CHECKPOINT = Path(__file__).parent / "prior" / "weights" / "prior.pt"
DEFAULT_POSE_CHECKPOINT = Path(__file__).parent / "prior" / "weights" / "pose.pt"

RESOLUTION_RANGE_MM = (0.3, 3.0)

LEAST_DISTILLATION = 1e-3
"""Weight of the prior where slices are dense; above zero so that every voxel of the head has one."""

Progress = Callable[[str, int, int], None]
"""Called with (stage, steps done, steps in all)."""


@dataclass
class GaussianReconstructor:
    """Reconstructs subjects with one prior and one set of settings.

    Args:
        checkpoint: prior file written by g3r-export; the weights that ship with the package when None.
        settings: see `ReconstructionSettings`, or the name of a preset.
        progress: called with (stage, done, total) as each stage goes on.
        pose_checkpoint: pose network and mean heads, written by g3r-export; those shipped when None.

    Raises:
        InputError: an unreadable or mismatched checkpoint, an unknown preset, a resolution outside 0.3-3 mm.
    """

    checkpoint: str | os.PathLike[str] | None = None
    settings: ReconstructionSettings | str = "balanced"
    progress: Progress = lambda stage, done, total: None
    pose_checkpoint: str | os.PathLike[str] | None = None
    pose_network: PoseNetwork | None = field(init=False, default=None)
    pose_meta: PoseCheckpoint | None = field(init=False, default=None)
    network: DensityGatedPriorNetwork | None = field(init=False, default=None)
    prior_meta: PriorCheckpoint | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if isinstance(self.settings, str):
            if self.settings not in PRESETS:
                raise InputError(f"preset {self.settings!r}; expected one of {', '.join(PRESETS)}")
            self.settings = PRESETS[self.settings]
        low, high = RESOLUTION_RANGE_MM
        if not low <= self.settings.resolution_mm <= high:
            raise InputError(
                f"resolution {self.settings.resolution_mm:g} mm; expected {low:g} to {high:g} mm"
            )
        if self.settings.use_prior:
            self.network, self.prior_meta = load_prior(Path(self.checkpoint or DEFAULT_CHECKPOINT))
        if self.settings.motion.template or self.settings.motion.network:
            path = Path(self.pose_checkpoint or DEFAULT_POSE_CHECKPOINT)
            self.pose_network, self.pose_meta = load_pose_network(path)

    def reconstruct(self, stacks: Sequence[Stack]) -> ReconstructionResult:
        """The volume, maps, poses and record of one subject.

        Raises:
            InputError: stacks that cannot be used.
            NumericalError: a fit that broke down.
        """
        assert isinstance(self.settings, ReconstructionSettings)
        settings, clock, notes, warnings = self.settings, _Clock(), [], []
        rng = np.random.default_rng(settings.seed)
        slices = slices_from_stacks(stacks)
        notes += _left_out(stacks, slices)
        first_scale = _percentile_scale(slices)
        slices = slices.scaled(1 / first_scale)
        if len(stacks) == 1:
            # a single stack says nothing about where its slices are relative to each other across planes;
            # registered to a volume made of themselves they drift
            settings = replace(
                settings,
                slice_stage=replace(settings.slice_stage, optimise_poses=False),
            )
            notes.append("shading not estimated: a single stack cannot tell it from anatomy")
            notes.append("slice poses not estimated: a single stack does not determine them")

        with clock("motion"):
            motion = self.register(slices, settings)
        confidences = stack_confidences(motion, len(stacks))
        warnings += pose_warnings(motion, confidences, stacks)
        if settings.motion.standard_orientation and motion.orientation is None:
            notes.append(
                "standard orientation unknown: no mean head fits well; the volume stays in scanner space"
            )
        with clock("coarse"):
            voxel = self.prior_meta.voxel_mm if self.prior_meta else settings.resolution_mm
            prior_grid = grid_around(motion.slices, voxel, margin_mm=5.0)
            trust = motion.weight[motion.slices.pixel_plane]
            coarse, density = coarse_and_density(motion.slices, prior_grid, motion.gain, trust)
            scale = normalisation_scale(coarse, density)
            coarse, slices = coarse / np.float32(scale), motion.slices.scaled(1 / scale)
            prior_mask = foreground_mask(slices, prior_grid, motion.weight)
        with clock("prior"):
            self.progress("prior", 0, 1)
            prior = self._prior(coarse, density)
            self.progress("prior", 1, 1)
        with clock("fit to prior"):
            cloud = seed_cloud(
                prior, prior_mask, prior_grid, _gaussian_spacing_mm(slices, settings), settings.flat_gradient
            )
            target = VolumeTarget.of(prior, prior_mask.astype(np.float32), prior_grid)
            cloud, prior_history = fit_prior(
                cloud, target, settings.prior_stage, rng, self._report("fit to prior")
            )
        with clock("fit to slices"):
            distil_to = None
            if settings.use_prior and settings.distillation:
                # the prior counts where slices are sparse; where they are dense they know better
                unmeasured = np.maximum(
                    prior_mask * (1 - confidence(density)), LEAST_DISTILLATION * prior_mask
                )
                distil_to = VolumeTarget.of(prior, unmeasured.astype(np.float32), prior_grid)
            fit = fit_slices(
                cloud, slices, motion.gain, motion.weight, distil_to, settings.slice_stage, rng,
                self._report("fit to slices"),
            )  # fmt: skip
        with clock("volume"):
            grid = _output_grid(prior_grid, settings.resolution_mm)
            mask = prior_mask
            if grid is not prior_grid:
                mask = foreground_mask(fit.slices, grid, fit.weight)
            volume = volume_from_pixels(render(fit.cloud, volume_planes(grid)).numpy(), grid) * mask
            if not np.isfinite(volume).all():
                raise NumericalError("the volume holds values that are not finite; lower the step sizes")
        intensity = first_scale * scale
        record = self._record(stacks, slices, motion, confidences, fit, clock, settings, notes, warnings)
        record["loss"] = {"fit to prior": prior_history, "fit to slices": fit.history}
        for warning in warnings:
            logger.warning(warning)
        return ReconstructionResult(
            volume * np.float32(intensity), mask, grid, prior * np.float32(intensity),
            coarse * np.float32(intensity), density, prior_grid, fit.cloud, intensity, fit.slices, fit.gain,
            fit.weight, motion.ncc, record,
        )  # fmt: skip

    def register(self, slices: Slices, settings: ReconstructionSettings | None = None) -> MotionEstimate:
        """Poses of all slices, with this reconstructor's template and pose network.

        Args:
            slices: at their header poses, intensities of order one.
            settings: those of the reconstructor when None.
        """
        chosen = settings or self.settings
        assert isinstance(chosen, ReconstructionSettings)
        proposals = {}
        if self.pose_network is not None and self.pose_meta is not None and chosen.motion.network:
            pose = predict_poses(self.pose_network, self.pose_meta, slices)
            proposals["network"] = pose @ slices.header_pose.inverse()
        template = self.pose_meta.template if self.pose_meta else None
        return estimate_motion(
            slices, chosen.motion, self._report("motion"), template=template, proposals=proposals
        )

    def _prior(self, coarse: NDArray[np.float32], density: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.network is None:
            return coarse
        return estimate_prior(self.network, coarse, density)

    def _report(self, stage: str) -> Callable[[int, int], None]:
        return lambda done, total: self.progress(stage, done, total)

    def _record(
        self,
        stacks: Sequence[Stack],
        slices: Slices,
        motion: MotionEstimate,
        confidences: list[StackConfidence],
        fit: SliceFit,
        clock: _Clock,
        settings: ReconstructionSettings,
        notes: list[str],
        warnings: list[str],
    ) -> dict[str, Any]:
        """run.json: what is needed to judge the result and to run it again; file names only, no paths."""
        of_stack = [slices.stack_id == n for n in range(len(stacks))]
        return {
            "g3r": __version__,
            "versions": {
                "python": platform.python_version(),
                "torch": torch.__version__,
                "numpy": np.__version__,
            },
            "settings": asdict(settings),
            "prior": asdict(self.prior_meta) if self.prior_meta else None,
            "stacks": [
                {
                    "name": stack.name,
                    "thickness_mm": stack.thickness_mm,
                    "spacing_mm": [round(float(x), 6) for x in stack.spacing_mm],
                    "n_slices": int(chosen.sum()),
                    "pose_confidence": confidences[n].record(),
                    "interleave": motion.interleave[n],
                    "n_runs": motion.n_runs[n],
                    "n_doubted_slices": int((fit.weight[chosen] < 0.5).sum()),
                }
                for n, (stack, chosen) in enumerate(zip(stacks, of_stack, strict=True))
            ],
            "shading": fit.shading,
            "n_gaussians": len(fit.cloud),
            "registration": {
                "trusted": all(one.sure for one in confidences),
                "summary": registration_summary(confidences),
            },
            "motion": {
                "start": motion.hypothesis,
                "held_out_correlation_by_start": motion.hypotheses,
                "orientation": "scanner" if motion.orientation is None else "standard",
                "correlation_with_mean_head": motion.orientation and motion.orientation.correlation,
                "rounds": motion.history,
            },
            "seconds": clock.seconds,
            "cpu_seconds": clock.cpu_seconds,
            "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            "notes": notes,
            "warnings": warnings,
        }


class _Clock:
    """Wall and CPU seconds of each stage, and a line in the log when it ends."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str):
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds[stage] = round(time.perf_counter() - wall, 3)
        self.cpu_seconds[stage] = round(time.process_time() - cpu, 3)
        logger.info("%s: %.1f s", stage, self.seconds[stage])


def _gaussian_spacing_mm(slices: Slices, settings: ReconstructionSettings) -> float:
    """Cell edge per Gaussian: the settings' number of (typical) pixels, as cubes of equal volume."""
    covered_mm3 = slices.planes.spacing_mm.prod(1) * slices.thickness_mm
    return settings.gaussian_spacing_pixels * float(np.median(covered_mm3)) ** (1 / 3)


def _left_out(stacks: Sequence[Stack], slices: Slices) -> list[str]:
    """A line for each stack of which slices were left out for want of masked pixels."""
    lines = []
    for n, stack in enumerate(stacks):
        marked = np.flatnonzero(stack.mask.any((0, 1)))
        missing = sorted(set(marked.tolist()) - set(slices.slice_index[slices.stack_id == n].tolist()))
        if missing:
            numbers = ", ".join(map(str, missing))
            lines.append(
                f"{stack.name}: slices {numbers} left out, fewer than {SMALLEST_SLICE_PIXELS} masked pixels"
            )
    return lines


def _percentile_scale(slices: Slices) -> float:
    scale = float(np.percentile(slices.masked_value, 99))
    if not scale > 0:
        raise InputError(f"99th percentile inside the masks is {scale:g}; expected a positive intensity")
    return scale


def _output_grid(prior_grid: VolumeGrid, resolution_mm: float) -> VolumeGrid:
    if np.isclose(prior_grid.spacing_mm[0], resolution_mm, rtol=1e-6):
        return prior_grid
    low, high = prior_grid.world([0, 0, 0]), prior_grid.world(np.array(prior_grid.shape) - 1)
    return VolumeGrid.isotropic(low, high, resolution_mm)
