"""GaussianReconstructor: the pipeline from stacks to a volume, a screen of calls."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coarse_volume import confidence
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import head_volume_mm3, normalised_slices
from g3r.acquisition.stacks import Stack
from g3r.errors import InputError
from g3r.fitting.adaptive_stage import fit_adaptive
from g3r.fitting.initial_volumes import FitStart, gaussian_spacing_mm, with_pixels_of
from g3r.fitting.prior_stage import VolumeTarget, fit_prior
from g3r.fitting.slice_stage import FitObserver, SliceFit, fit_slices
from g3r.gaussians.seeding import seed_cloud
from g3r.output.assemble import Cut, RunSoFar, cut_short, finished
from g3r.output.record import Clock, skipped_slice_notes
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS, ReconstructionSettings
from g3r.planning.time_budget import TimeBudget
from g3r.pose_network.checkpoint import PoseCheckpoint, load_pose_network
from g3r.pose_network.inference import predict_poses
from g3r.pose_network.network import PoseNetwork
from g3r.prior.checkpoint import PriorCheckpoint, load_prior
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inference import estimate_prior
from g3r.registration import Registration, register
from g3r.registration.prior_registration import register_to_prior
from g3r.registration.quality import pose_warnings, stack_qualities
from g3r.registration.template_search import template_fits
from g3r.run.allocator import release_memory
from g3r.run.deadline import Deadline
from g3r.run.stage_store import PriorCloud, PriorVolume, Stages, stage_rng
from g3r.run.stop_request import StopRequest

DEFAULT_CHECKPOINT = Path(__file__).parent / "checkpoints" / "weights" / "prior.pt"
DEFAULT_POSE_CHECKPOINT = Path(__file__).parent / "checkpoints" / "weights" / "pose.pt"

RESOLUTION_RANGE_MM = (0.3, 3.0)

MIN_DISTILLATION = 1e-3
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
    _at: tuple[str, int, int] = field(init=False, default=("", 0, 0))

    def __post_init__(self) -> None:
        if isinstance(self.settings, str):
            if self.settings not in PRESETS:
                raise InputError(f"preset {self.settings!r}; expected one of {', '.join(PRESETS)}")
            self.settings = PRESETS[self.settings]
        low, high = RESOLUTION_RANGE_MM
        if not low <= self.settings.resolution_mm <= high:
            raise InputError(f"resolution {self.settings.resolution_mm:g} mm; expected {low:g} to {high:g} mm")
        if self.settings.use_prior:
            path = Path(self.checkpoint or DEFAULT_CHECKPOINT)
            self.network, self.prior_meta = load_prior(path, self.settings.prior_voxel_mm)
        if self.settings.registration.template or self.settings.registration.network:
            path = Path(self.pose_checkpoint or DEFAULT_POSE_CHECKPOINT)
            self.pose_network, self.pose_meta = load_pose_network(path)

    def reconstruct(
        self,
        stacks: Sequence[Stack],
        motion: Registration | None = None,
        budget: TimeBudget | None = None,
        *,
        stages: Stages | None = None,
        stop_request: StopRequest | None = None,
    ) -> ReconstructionResult:
        """The volume, maps, poses and record of one subject.

        Args:
            stacks: one or more, of one head.
            motion: what `register_stacks` (here or elsewhere) found for the same stacks, to fit
                several times to one registration; found here when None. Slices of a single stack still move
                to the prior volume afterwards, where there is one.
            budget: chooses registration, views of the prior, Gaussians and steps in place of the settings.
            stages: keeps what each stage gives, or has it from an earlier run; nothing is kept when None.
            stop_request: a signal during the fit gives the volume so far (`record["partial"]`); before it,
                and without this, `KeyboardInterrupt` passes through.

        Raises:
            InputError: stacks that cannot be used, or a motion of other slices.
            NumericalError: a fit that broke down.
        """
        assert isinstance(self.settings, ReconstructionSettings)
        stages = stages or Stages()
        clock, notes, by_then = stages.clock, list[str](), None
        slices, first_scale = normalised_slices(stacks)
        notes += skipped_slice_notes(stacks, slices)
        single = slices.n_stacks == 1
        settings = _settings_for(self.settings, single)
        if single:
            notes.append("shading not estimated: a single stack cannot tell it from anatomy")
        if motion is not None:
            with clock("motion"):
                motion = with_pixels_of(slices, motion)
            notes.append("motion was given, not estimated here")
        else:
            if budget:
                settings, by_then = budget.for_registration(settings)
            motion = stages.once("motion", lambda: self._motion(slices, settings, clock, by_then))
        qualities = stack_qualities(motion, len(stacks))
        warnings = pose_warnings(motion, qualities, stacks)
        if settings.registration.standard_orientation and motion.orientation is None:
            notes.append(
                "standard orientation unknown, the volume stays in scanner space: no mean head fits the "
                f"{head_volume_mm3(slices) / 1000:.0f} ml that are masked; check the masks"
            )
        volume, settings = self._prior_volume(motion, settings, stages, budget, single)
        notes += _notes_on_single(volume.accepted) if single else []
        intensity = first_scale * volume.scale
        run = RunSoFar(
            stacks,
            settings,
            self.prior_meta,
            self.pose_meta,
            motion,
            qualities,
            volume,
            intensity,
            stages,
            budget,
            notes,
            warnings,
        )
        try:
            second_by = None
            if budget:
                settings, by_then, second_by = budget.for_fit(
                    settings,
                    volume.start,
                    volume.prior,
                    clock.seconds["coarse"],
                    math.prod(run.grid.shape),
                    np.random.default_rng(settings.seed),
                )
                run = replace(run, settings=settings)
            first = stages.once("fit to prior", lambda: self._prior_cloud(run, by_then))
        except KeyboardInterrupt:
            if stop_request is None or not stop_request.is_requested():
                raise
            stop_request.postpone()
            return cut_short(run, self._cut("fit to prior", settings.prior_stage.n_steps), None, None)
        if stop_request is None:
            return finished(run, first, stages.once("fit to slices", lambda: self._fit(run, first, second_by)))
        stop_request.postpone()
        second_by = stop_request.cut(second_by)
        fit = stages.once("fit to slices", lambda: self._fit(run, first, second_by), unless=stop_request.is_requested)
        if stop_request.is_requested():
            cut = Cut("fit to slices", len(fit.history), settings.slice_stage.n_steps)
            return cut_short(run, cut, first, fit)
        return finished(run, first, fit)

    def register_stacks(self, stacks: Sequence[Stack]) -> Registration:
        """Poses of all slices of some stacks, as `reconstruct` finds them and takes them.

        Raises:
            InputError: stacks that cannot be used.
        """
        return self.register(normalised_slices(stacks)[0])

    def register(
        self, slices: Slices, settings: ReconstructionSettings | None = None, deadline: Deadline | None = None
    ) -> Registration:
        """Poses of all slices, with this reconstructor's template and pose network.

        Args:
            slices: at their header poses, intensities of order one.
            settings: those of the reconstructor when None.
            deadline: see `register`.
        """
        chosen = settings or self.settings
        assert isinstance(chosen, ReconstructionSettings)
        template = self.pose_meta.template if self.pose_meta else None
        proposals = {}
        wanted = chosen.registration.network
        if chosen.registration.network_as_reserve:
            wanted &= template is None or not template_fits(slices, template)
        if self.pose_network is not None and self.pose_meta is not None and wanted:
            pose = predict_poses(self.pose_network, self.pose_meta, slices)
            proposals["network"] = pose @ slices.header_pose.inverse()
        return register(
            slices,
            chosen.registration,
            self._report("motion"),
            template=template,
            proposals=proposals,
            deadline=deadline,
        )

    def _motion(
        self, slices: Slices, settings: ReconstructionSettings, clock: Clock, deadline: Deadline | None
    ) -> Registration:
        with clock("motion"):
            return self.register(slices, settings, deadline)

    def _prior_volume(
        self,
        motion: Registration,
        settings: ReconstructionSettings,
        stages: Stages,
        budget: TimeBudget | None,
        single: bool,
    ) -> tuple[PriorVolume, ReconstructionSettings]:
        """The prior volume, and the settings with the views that the budget allowed."""
        chosen = settings

        def make() -> PriorVolume:
            nonlocal chosen
            clock, gain = stages.clock, motion.gain
            voxel_mm = self.prior_meta.voxel_mm if self.prior_meta else settings.resolution_mm
            with clock("coarse"):
                start = FitStart.of(motion.slices, gain, motion.weight, voxel_mm)
            if budget:
                chosen = budget.for_prior(settings, clock.seconds["coarse"])
            with clock("prior"):
                self.progress("prior", 0, 1)
                prior = self._prior(start, chosen)
                self.progress("prior", 1, 1)
            scale, accepted = start.scale, None
            if single and settings.use_prior and settings.registration.segments:
                with clock("slices to prior"):
                    nudged, gain, accepted = register_to_prior(start.slices, gain, prior, start.grid)
                    if accepted:
                        start = FitStart.of(nudged, gain, motion.weight, voxel_mm)
                        scale *= start.scale
                        prior = self._prior(start, chosen)
            return PriorVolume(start, prior, gain, scale, accepted)

        return stages.once("prior", make), chosen

    def _prior(self, start: FitStart, settings: ReconstructionSettings) -> NDArray[np.float32]:
        if self.network is None:
            return start.sharp
        prior = estimate_prior(
            self.network,
            start.coarse,
            start.density,
            start.sharp,
            n_views=settings.prior_views,
            max_whole_voxels=settings.prior_whole_voxels,
            tile_voxels=settings.prior_tile_voxels,
            halo_voxels=settings.prior_halo_voxels,
        )
        release_memory()  # the most that is ever freed at a time
        return prior

    def _prior_cloud(self, run: RunSoFar, deadline: Deadline | None) -> PriorCloud:
        """Stage 1 of the fit."""
        settings, start, prior = run.settings, run.volume.start, run.volume.prior
        report, stage = self._report("fit to prior"), settings.prior_stage
        rng = stage_rng(settings.seed, "fit to prior")
        spacing_mm = gaussian_spacing_mm(start.slices, settings.gaussian_spacing_pixels)
        with run.stages.clock("fit to prior"):
            if settings.adaptive is not None:
                cloud, found = fit_adaptive(
                    prior,
                    start.mask,
                    start.grid,
                    finest_spacing_mm=spacing_mm,
                    settings=settings.adaptive,
                    stage=stage,
                    rng=rng,
                    progress=report,
                    deadline=deadline,
                )
                counts = {"seeding": "error bound", "finest_spacing_mm": spacing_mm, **found.record()}
                return PriorCloud(cloud, found.loss, counts)
            cloud = seed_cloud(prior, start.mask, start.grid, spacing_mm)
            counts = {"seeding": "lattice", "finest_spacing_mm": spacing_mm, "n_seeded": len(cloud)}
            target = VolumeTarget.of(prior, start.mask.astype(np.float32), start.grid)
            cloud, history = fit_prior(cloud, target, stage, rng, progress=report, deadline=deadline)
            return PriorCloud(cloud, history, counts)

    def _fit(self, run: RunSoFar, first: PriorCloud, deadline: Deadline | None) -> SliceFit:
        """Stage 2 of the fit."""
        settings, start = run.settings, run.volume.start
        with run.stages.clock("fit to slices"):
            distil_to = None
            if settings.use_prior and settings.distillation:
                # the prior counts where slices are sparse; where they are dense they know better. It was made
                # of the same slices: from several stacks only 1 - c of what it says there is its own
                power = 1 if start.slices.n_stacks == 1 else 2
                unmeasured = np.maximum((1 - confidence(start.density)) ** power, MIN_DISTILLATION)
                slice_weight = (unmeasured * start.mask).astype(np.float32)
                distil_to = VolumeTarget.of(run.volume.prior, slice_weight, start.grid)
            return fit_slices(
                first.cloud,
                start.slices,
                gain=run.volume.gain,
                weight=run.motion.weight,
                prior=distil_to,
                settings=settings.slice_stage,
                rng=stage_rng(settings.seed, "fit to slices"),
                progress=self._report("fit to slices"),
                deadline=deadline,
                observer=self.observer,
            )

    def _report(self, stage: str) -> Callable[[int, int], None]:
        def report(done: int, total: int) -> None:
            self._at = stage, done, total
            self.progress(stage, done, total)

        return report

    def _cut(self, stage: str, n_steps: int) -> Cut:
        """Where the run is now, if it has begun the stage."""
        return Cut(*self._at) if self._at[0] == stage else Cut(stage, 0, n_steps)


def _settings_for(settings: ReconstructionSettings, single: bool) -> ReconstructionSettings:
    """The settings as they hold for a single stack, or for several."""
    stage = settings.slice_stage
    if single:
        # registered to a volume made of themselves, slices of a single stack drift; the prior holds them
        held = settings.use_prior and settings.distillation and settings.registration.segments
        return replace(settings, slice_stage=replace(stage, optimise_poses=stage.optimise_poses and held))
    # several stacks check each other: the schedule alone decides how hard the prior pulls
    return replace(settings, slice_stage=replace(stage, prior_error=0.0))


def _notes_on_single(accepted: bool | None) -> list[str]:
    if accepted is None:
        return ["slices of the single stack stay where the mean head or the header has them"]
    if accepted:
        return ["slices of the single stack were registered to the prior volume"]
    return ["slices of the single stack stay in line up to the fit: the prior gave no reason to move"]
