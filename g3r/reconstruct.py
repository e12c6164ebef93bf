"""GaussianReconstructor: the pipeline from stacks to a volume, a screen of calls."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.foreground import foreground_mask
from g3r.acquisition.planes import (
    Slices,
    volume_from_pixels,
    volume_planes,
)
from g3r.acquisition.scatter import confidence
from g3r.acquisition.stacks import Stack
from g3r.budget import TimeBudget
from g3r.errors import InputError, NumericalError
from g3r.fitting.adaptive_stage import fit_adaptive
from g3r.fitting.observer import FitObserver
from g3r.fitting.prior_share import estimate_prior_share
from g3r.fitting.prior_stage import VolumeTarget, fit_prior
from g3r.fitting.slice_stage import fit_slices
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import VolumeGrid
from g3r.memory import give_back
from g3r.motion import MotionEstimate, estimate_motion
from g3r.motion.confidence import (
    pose_warnings,
    registration_trusted,
    stack_confidences,
)
from g3r.motion.prior_registration import register_to_prior
from g3r.motion.template_registration import head_volume_mm3, template_fits
from g3r.pace import Deadline
from g3r.presets import PRESETS, ReconstructionSettings
from g3r.prior import PriorCheckpoint, estimate_prior, load_pose_network, load_prior, predict_poses
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.pose_checkpoint import PoseCheckpoint
from g3r.prior.pose_network import PoseNetwork
from g3r.result import ReconstructionResult
from g3r.run_record import Clock, left_out_notes, left_out_terms, run_record
from g3r.start import FitStart, gaussian_spacing_mm, normalised_slices, with_pixels_of
from g3r.trust import estimate_uncertainty

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
        observer: sees the cloud as the fit to the slices goes on.

    Raises:
        InputError: an unreadable or mismatched checkpoint, an unknown preset, a resolution outside 0.3-3 mm.
    """

    checkpoint: str | os.PathLike[str] | None = None
    settings: ReconstructionSettings | str = "balanced"
    progress: Progress = lambda stage, done, total: None
    pose_checkpoint: str | os.PathLike[str] | None = None
    observer: FitObserver | None = None
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
            path = Path(self.checkpoint or DEFAULT_CHECKPOINT)
            self.network, self.prior_meta = load_prior(path, self.settings.prior_voxel_mm)
        if self.settings.motion.template or self.settings.motion.network:
            path = Path(self.pose_checkpoint or DEFAULT_POSE_CHECKPOINT)
            self.pose_network, self.pose_meta = load_pose_network(path)

    def reconstruct(
        self,
        stacks: Sequence[Stack],
        motion: MotionEstimate | None = None,
        budget: TimeBudget | None = None,
    ) -> ReconstructionResult:
        """The volume, maps, poses and record of one subject.

        Args:
            stacks: one or more, of one head.
            motion: what `register_stacks` (here or elsewhere) found for the same stacks, to fit
                several times to one registration; found here when None. Slices of a single stack still move
                to the prior volume afterwards, where there is one.
            budget: chooses registration, views of the prior, Gaussians and steps in place of the settings.

        Raises:
            InputError: stacks that cannot be used, or a motion of other slices.
            NumericalError: a fit that broke down.
        """
        assert isinstance(self.settings, ReconstructionSettings)
        settings, clock, notes, warnings = self.settings, Clock(), [], []
        rng = np.random.default_rng(settings.seed)
        slices, first_scale = normalised_slices(stacks)
        notes += left_out_notes(stacks, slices)
        single = len(np.unique(slices.stack_id)) == 1
        held = settings.use_prior and settings.distillation and settings.motion.runs
        if single:
            # registered to a volume made of themselves, slices of a single stack drift; the prior holds them
            stage = settings.slice_stage
            settings = replace(
                settings, slice_stage=replace(stage, optimise_poses=stage.optimise_poses and held)
            )
            notes.append("shading not estimated: a single stack cannot tell it from anatomy")
        else:
            # several stacks check each other: the schedule alone decides how hard the prior pulls
            settings = replace(settings, slice_stage=replace(settings.slice_stage, prior_error=0.0))

        with clock("motion"):
            if motion is None:
                by_then = None
                if budget:
                    settings, by_then = budget.for_motion(settings)
                motion = self.register(slices, settings, by_then)
            else:
                motion = with_pixels_of(slices, motion)
                notes.append("motion was given, not estimated here")
        confidences = stack_confidences(motion, len(stacks))
        warnings += pose_warnings(motion, confidences, stacks)
        if settings.motion.standard_orientation and motion.orientation is None:
            notes.append(
                "standard orientation unknown, the volume stays in scanner space: no mean head fits the "
                f"{head_volume_mm3(slices) / 1000:.0f} ml that are masked; check the masks"
            )
        voxel_mm = self.prior_meta.voxel_mm if self.prior_meta else settings.resolution_mm
        with clock("coarse"):
            start = FitStart.of(motion.slices, motion.gain, motion.weight, voxel_mm)
        if budget:
            settings = budget.for_prior(settings, clock.seconds["coarse"])
        with clock("prior"):
            self.progress("prior", 0, 1)
            prior = self._prior(start, settings)
            self.progress("prior", 1, 1)
        gain, scale = motion.gain, start.scale
        if single and settings.use_prior and settings.motion.runs:
            with clock("slices to prior"):
                nudged, gain, believed = register_to_prior(start.slices, gain, prior, start.grid)
                if believed:
                    start = FitStart.of(nudged, gain, motion.weight, voxel_mm)
                    scale *= start.scale
                    prior = self._prior(start, settings)
            notes.append(
                "slices of the single stack were registered to the prior volume" if believed else
                "slices of the single stack stay in line up to the fit: the prior gave no reason to move"
            )  # fmt: skip
        elif single:
            notes.append("slices of the single stack stay where the mean head or the header has them")
        slices, prior_mask, prior_grid = start.slices, start.mask, start.grid
        coarse, density = start.coarse, start.density
        grid = _output_grid(prior_grid, settings.resolution_mm)
        first_by, second_by = None, None
        if budget:
            settings, first_by, second_by = budget.for_fit(
                settings, start, prior, clock.seconds["coarse"], math.prod(grid.shape), rng
            )
        with clock("fit to prior"):
            cloud, prior_history, counts = self._prior_cloud(prior, start, settings, rng, first_by)
        with clock("fit to slices"):
            distil_to = None
            if settings.use_prior and settings.distillation:
                # the prior counts where slices are sparse; where they are dense they know better. It was made
                # of the same slices: from several stacks only 1 - c of what it says there is its own
                power = 1 if single else 2
                unmeasured = np.maximum((1 - confidence(density)) ** power, LEAST_DISTILLATION) * prior_mask
                distil_to = VolumeTarget.of(prior, unmeasured.astype(np.float32), prior_grid)
            fit = fit_slices(
                cloud, slices, gain, motion.weight, distil_to, settings.slice_stage, rng,
                self._report("fit to slices"), second_by, self.observer,
            )  # fmt: skip
        with clock("volume"):
            mask = prior_mask
            if grid is not prior_grid:
                mask = foreground_mask(fit.slices, grid, fit.weight)
            cutoff = settings.slice_stage.cutoff_sigma
            pixels = render(fit.cloud, volume_planes(grid), cutoff_sigma=cutoff).numpy()
            volume = volume_from_pixels(pixels, grid) * mask
            if not np.isfinite(volume).all():
                raise NumericalError("the volume holds values that are not finite; lower the step sizes")
        intensity = first_scale * scale
        prior_share = None
        if settings.use_prior:
            with clock("prior share"):
                prior_share = estimate_prior_share(
                    fit, density, prior_grid, mask, grid, rng, settings.share_probes,
                    record_bytes=settings.slice_stage.record_bytes,
                )  # fmt: skip
                give_back()
        with clock("uncertainty"):
            uncertainty = estimate_uncertainty(
                volume, mask, grid, fit, prior=prior, density=density, prior_grid=prior_grid,
                prior_share=prior_share, with_prior=settings.use_prior, intensity=intensity,
                trusted=registration_trusted(confidences),
            )  # fmt: skip
        record = run_record(
            settings, self.prior_meta, self.pose_meta, stacks, slices, motion, confidences, fit, clock, notes,
            warnings,
        )  # fmt: skip
        record["time_budget"] = budget.record() if budget else None
        record["gaussians"] = counts | {"n_final": len(fit.cloud)}
        record["left_out"] = left_out_terms(slices, settings, counts)
        record["uncertainty"] = uncertainty.record
        record["loss"] = {"fit to prior": prior_history, "fit to slices": fit.history}
        for warning in warnings:
            logger.warning(warning)
        return ReconstructionResult(
            volume * np.float32(intensity), mask, grid, prior * np.float32(intensity),
            coarse * np.float32(intensity), density, prior_grid, fit.cloud, intensity, fit.slices, fit.gain,
            fit.weight, motion.ncc, uncertainty.expected_error, prior_share, record,
        )  # fmt: skip

    def register_stacks(self, stacks: Sequence[Stack]) -> MotionEstimate:
        """Poses of all slices of some stacks, as `reconstruct` finds them and takes them.

        Raises:
            InputError: stacks that cannot be used.
        """
        return self.register(normalised_slices(stacks)[0])

    def register(
        self,
        slices: Slices,
        settings: ReconstructionSettings | None = None,
        deadline: Deadline | None = None,
    ) -> MotionEstimate:
        """Poses of all slices, with this reconstructor's template and pose network.

        Args:
            slices: at their header poses, intensities of order one.
            settings: those of the reconstructor when None.
            deadline: see `estimate_motion`.
        """
        chosen = settings or self.settings
        assert isinstance(chosen, ReconstructionSettings)
        template = self.pose_meta.template if self.pose_meta else None
        proposals = {}
        wanted = chosen.motion.network
        if chosen.motion.network_as_reserve:
            wanted &= template is None or not template_fits(slices, template)
        if self.pose_network is not None and self.pose_meta is not None and wanted:
            pose = predict_poses(self.pose_network, self.pose_meta, slices)
            proposals["network"] = pose @ slices.header_pose.inverse()
        return estimate_motion(
            slices, chosen.motion, self._report("motion"), template=template, proposals=proposals,
            deadline=deadline,
        )  # fmt: skip

    def _prior(self, start: FitStart, settings: ReconstructionSettings) -> NDArray[np.float32]:
        if self.network is None:
            return start.sharp
        prior = estimate_prior(
            self.network, start.coarse, start.density, start.sharp, n_views=settings.prior_views,
            max_whole_voxels=settings.prior_whole_voxels, tile_voxels=settings.prior_tile_voxels,
            halo_voxels=settings.prior_halo_voxels,
        )  # fmt: skip
        give_back()  # the most that is ever freed at a time
        return prior

    def _prior_cloud(
        self,
        prior: NDArray[np.float32],
        start: FitStart,
        settings: ReconstructionSettings,
        rng: np.random.Generator,
        deadline: Deadline | None,
    ) -> tuple[GaussianCloud, list[float], dict[str, Any]]:
        """Stage 1: the cloud, its losses, and how its number of Gaussians came about."""
        report, stage = self._report("fit to prior"), settings.prior_stage
        spacing_mm = gaussian_spacing_mm(start.slices, settings.gaussian_spacing_pixels)
        if settings.adaptive is not None:
            cloud, found = fit_adaptive(
                prior, start.mask, start.grid, spacing_mm, settings.adaptive, stage, rng, report, deadline
            )
            counts = {"seeding": "error bound", "finest_spacing_mm": spacing_mm, **found.record()}
            return cloud, found.loss, counts
        cloud = seed_cloud(prior, start.mask, start.grid, spacing_mm)
        counts = {"seeding": "lattice", "finest_spacing_mm": spacing_mm, "n_seeded": len(cloud)}
        target = VolumeTarget.of(prior, start.mask.astype(np.float32), start.grid)
        cloud, history = fit_prior(cloud, target, stage, rng, report, deadline)
        return cloud, history, counts

    def _report(self, stage: str) -> Callable[[int, int], None]:
        return lambda done, total: self.progress(stage, done, total)


def _output_grid(prior_grid: VolumeGrid, resolution_mm: float) -> VolumeGrid:
    if np.isclose(prior_grid.spacing_mm[0], resolution_mm, rtol=1e-6):
        return prior_grid
    low, high = prior_grid.world([0, 0, 0]), prior_grid.world(np.array(prior_grid.shape) - 1)
    return VolumeGrid.isotropic(low, high, resolution_mm)
