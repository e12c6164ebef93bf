"""GaussianReconstructor: the way of the data from stacks to a volume."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

from g3r.acquisition.intensity_levels import level_notes, same_level
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import normalised_slices, skipped_slice_notes
from g3r.acquisition.stacks import Stack, check_together
from g3r.checkpoints.weights_file import WeightsFile
from g3r.fitting.fit_context import FitContext
from g3r.fitting.held_out_slices import HeldOutChoice, ask_held_out_slices
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.lattice_mean import fit_lattices
from g3r.fitting.mask_agreement import REFINED
from g3r.fitting.observer import FitObserver
from g3r.fitting.pose_rounds import PoseRounds, RefinedPoses, refine_in_rounds
from g3r.fitting.prior_stage import PriorCloud
from g3r.fitting.prior_targets import fit_to_prior
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.slice_targets import slice_target
from g3r.fitting.subject_prior import NOTE_ON_SINGLE
from g3r.networks import Networks
from g3r.output.assemble import assemble
from g3r.output.stage_results import StageResults
from g3r.planning.plan import FixedPlan, Plan
from g3r.planning.presets import ReconstructionSettings, adapted, settings_of
from g3r.planning.stages import Stage, stage_rng
from g3r.registration import GivenPoses, Registration, RegistrationSettings, register_robustly
from g3r.registration.atlas_search import template_fits
from g3r.registration.given import measure, with_pixels_of
from g3r.registration.quality import unknown_orientation_note
from g3r.report.reported_result import ReportedResult
from g3r.run.context import RunContext
from g3r.run.deadline import Deadline
from g3r.run.progress import Progress, no_progress


class GaussianReconstructor:
    """Reconstructs subjects with one prior and one set of settings.

    Args:
        checkpoint: prior written by g3r-export, or the name of a set of weights that ships with the package
            ("cc0"); the usual set when None.
        settings: see `ReconstructionSettings`, or the name of a preset.
        pose_checkpoint: pose network and atlas template; when None those of the set that `checkpoint` names.
        device: of the networks, see `device_of`.
        observer: sees both stages of the fit.

    Raises:
        InputError: an unreadable or mismatched checkpoint, an unknown preset, a resolution outside 0.3-3 mm, no GPU.
    """

    def __init__(
        self,
        checkpoint: str | os.PathLike[str] | WeightsFile | None = None,
        settings: ReconstructionSettings | str = "balanced",
        *,
        pose_checkpoint: str | os.PathLike[str] | WeightsFile | None = None,
        device: str = "auto",
        observer: FitObserver | None = None,
    ) -> None:
        self.settings, self.observer = settings_of(settings), observer
        self.networks = Networks(checkpoint, pose_checkpoint, self.settings, device)

    def reconstruct(
        self,
        stacks: Sequence[Stack],
        registration: Registration | GivenPoses | None = None,
        *,
        plan: Plan | None = None,
        run: RunContext | None = None,
    ) -> ReportedResult:
        """The volume, maps, poses and record of one subject.

        Args:
            stacks: one or more, of one head.
            registration: what `register_stacks` found for the same stacks, or poses that `read_slice_folder` read with
                them; found here when None. Slices of a single stack still move to the prior volume afterwards.
            plan: settings and deadlines; the reconstructor's settings without a deadline when None.
            run: stage store, stop request and reporter. A stop request during the fit gives the volume so far
                (`record.partial`); else `KeyboardInterrupt` passes through.

        Raises:
            InputError: stacks that cannot be used (see `check_together`), or a registration of other slices.
            NumericalError: a fit that broke down.
        """
        plan, run = plan or FixedPlan(self.settings), run or RunContext()
        if plan.settings.use_prior:
            self.networks.start()  # their libraries are imported while poses are found
        check_together(stacks)
        stacks = same_level(stacks)
        slices, intensity = normalised_slices(stacks)
        run.notes += level_notes(stacks) + skipped_slice_notes(stacks, slices)
        poses = self._poses(slices, registration, plan, run)
        stacks, poses = self._masks(stacks, poses, intensity, plan, run)
        maker = self.networks.subject_prior(plan.settings)
        poses, stack_fields = maker.matched(poses)  # quick, so not kept
        prior = self._prior(run.stage(Stage.COARSE, lambda: maker.volumes(poses)), poses, plan, run)
        prior, poses, rounds = self._rounds(prior, poses, plan, run)
        cloud = self._fit_to_prior(prior, plan, run)
        held_out = self._held_out(cloud, prior, poses, plan, run)
        prior_record, pose_record = self.networks.records()
        found = StageResults(
            stacks=stacks,
            registration=poses,
            stack_fields=stack_fields,
            prior=prior,
            rounds=rounds,
            intensity=intensity * prior.scale,
            cloud=cloud,
            held_out=held_out,
            fit=self._fit_to_slices(cloud, prior, poses, held_out, plan, run),
            prior_record=prior_record if plan.settings.use_prior else None,
            pose_record=pose_record,
        )
        return ReportedResult.of(assemble(found, plan, run))

    def register_stacks(self, stacks: Sequence[Stack]) -> Registration:
        """Poses of all slices of some stacks, as `reconstruct` estimates them and accepts them as its argument.

        Raises:
            InputError: stacks that cannot be used (see `check_together`).
        """
        check_together(stacks)
        return self.register(normalised_slices(same_level(stacks))[0])

    def register(
        self,
        slices: Slices,
        settings: RegistrationSettings | None = None,
        progress: Progress = no_progress,
        deadline: Deadline | None = None,
    ) -> Registration:
        """Poses of all slices, with this reconstructor's template and pose network.

        Args:
            slices: at their header poses, intensities of order one.
            settings: those of the reconstructor when None.
            progress: called with (rounds done, rounds in all).
            deadline: when the search has to end.
        """
        settings, template, proposals = settings or self.settings.registration, self.networks.template, {}
        spare = settings.network_as_reserve and template is not None and template_fits(slices, template)
        if settings.network and not spare and (proposed := self.networks.proposed_motion(slices)) is not None:
            proposals["network"] = proposed
        return register_robustly(slices, settings, progress, template=template, proposals=proposals, deadline=deadline)

    def _poses(
        self, slices: Slices, given: Registration | GivenPoses | None, plan: Plan, run: RunContext
    ) -> Registration:
        """The slices in their poses: estimated, given, or from a given registration."""
        deadline = plan.for_registration() if given is None else None  # before settings are read: it may change them
        asked, report = plan.settings.registration, run.report(Stage.REGISTRATION)
        if isinstance(given, GivenPoses):
            run.notes += given.notes
            poses = run.stage(
                Stage.REGISTRATION, lambda: measure(slices, given, asked, report, template=self.networks.template)
            )
        elif given is not None:
            run.notes.append("registration was given, not estimated here")
            with run.timed(Stage.REGISTRATION) as tell:
                tell(poses := with_pixels_of(slices, given))
        else:
            poses = run.stage(Stage.REGISTRATION, lambda: self.register(slices, asked, report, deadline))
        if asked.standard_orientation and poses.orientation is None:
            run.notes.append(unknown_orientation_note(slices))
        return poses

    def _masks(
        self, stacks: Sequence[Stack], poses: Registration, intensity: float, plan: Plan, run: RunContext
    ) -> tuple[Sequence[Stack], Registration]:
        """Stacks and slices with automatic masks refined by what registration knows."""
        if not any(stack.mask_source == REFINED for stack in stacks):
            return stacks, poses
        with run.timed(Stage.MASKS) as tell:
            tell(refined := self.networks.subject_prior(plan.settings).refined_masks(stacks, poses, intensity))
        run.notes += refined.notes
        return refined.stacks, refined.poses

    def _prior(self, volumes: InitialVolumes, poses: Registration, plan: Plan, run: RunContext) -> PriorVolume:
        """V_prior (Eq. 7); slices of a single stack, which no other stack checks, move towards it if it fits them."""
        plan.for_prior(run.clock.seconds[Stage.COARSE])
        maker = self.networks.subject_prior(plan.settings)
        n_stacks, tiling = volumes.slices.n_stacks, plan.settings.tiling
        # V_prior is made anew after each round, the last time with all views
        views = 1 if adapted(plan.settings, n_stacks).pose_rounds.n_rounds(n_stacks) else plan.settings.prior_views
        prior = run.stage(Stage.PRIOR, lambda: maker.of(volumes, poses, views, tiling))
        if n_stacks > 1:
            return prior
        if plan.settings.use_prior and plan.settings.registration.segments:
            moved, n_moves = maker.with_slices_moved, plan.settings.pose_rounds.moves_to_prior
            prior = run.stage(Stage.SLICES_TO_PRIOR, lambda: moved(prior, poses, n_moves, views, tiling))
        run.notes.append(NOTE_ON_SINGLE[prior.accepted])
        return prior

    def _rounds(
        self, prior: PriorVolume, poses: Registration, plan: Plan, run: RunContext
    ) -> tuple[PriorVolume, Registration, PoseRounds | None]:
        """Prior volume and poses after rounds of both; unchanged if no round is due, or if a stop was requested."""
        settings = adapted(plan.settings, prior.volumes.slices.n_stacks)
        n_rounds = settings.pose_rounds.n_rounds(prior.volumes.slices.n_stacks)
        if not n_rounds:
            return prior, poses, None

        def prior_of(moved: Registration, last: bool) -> PriorVolume:
            return self.networks.subject_prior(plan.settings).again(
                moved, prior, settings.prior_views if last else 1, settings.tiling
            )

        def refine() -> RefinedPoses:
            return refine_in_rounds(
                poses,
                prior,
                n_rounds,
                prior_of=prior_of,
                fit=settings.round_fit,
                rng=stage_rng(settings.seed, Stage.POSE_ROUNDS),
                progress=run.report(Stage.POSE_ROUNDS),
            )

        found = run.droppable_stage(Stage.POSE_ROUNDS, refine)
        return (prior, poses, None) if found is None else (found.prior, found.registration, found.record)

    def _fit_to_prior(self, prior: PriorVolume, plan: Plan, run: RunContext) -> PriorCloud | None:
        """Gaussians seeded in the prior volume and fitted to it (Eq. 8); None if stopped."""
        volumes, coarse_s = prior.volumes, run.clock.seconds[Stage.COARSE]
        n_output_voxels = math.prod(volumes.grid.respaced(plan.settings.resolution_mm).shape)
        deadline, settings = plan.for_fit_to_prior(prior, coarse_s, n_output_voxels), plan.settings
        if run.stopped_at is not None or not settings.n_lattices:
            return None

        def fit() -> PriorCloud:
            spacing_mm = settings.lattice.mm(volumes.slices)
            context = self._context(Stage.FIT_TO_PRIOR, settings.seed, deadline, run)
            return fit_to_prior(prior, spacing_mm=spacing_mm, stage=settings.prior_stage, context=context)

        return run.droppable_stage(Stage.FIT_TO_PRIOR, fit)

    def _held_out(
        self, cloud: PriorCloud | None, prior: PriorVolume, poses: Registration, plan: Plan, run: RunContext
    ) -> HeldOutChoice | None:
        """Widths of the slice profiles by held-out slices; None where these are not used."""
        settings = adapted(plan.settings, prior.volumes.slices.n_stacks)
        if cloud is None or (asked := settings.held_out) is None:
            return None

        def ask() -> HeldOutChoice:
            return ask_held_out_slices(
                cloud.cloud,
                prior,
                poses.weight,
                distillation=settings.use_prior and settings.distillation,
                model=settings.slice_model,
                stage=settings.slice_stage,
                settings=asked,
                rng=stage_rng(settings.seed, Stage.HELD_OUT),
                progress=run.report(Stage.HELD_OUT),
            )

        return run.droppable_stage(Stage.HELD_OUT, ask)

    def _fit_to_slices(
        self,
        cloud: PriorCloud | None,
        prior: PriorVolume,
        poses: Registration,
        held_out: HeldOutChoice | None,
        plan: Plan,
        run: RunContext,
    ) -> SliceFit | None:
        """Gaussians and poses fitted to the slices (Eq. 9); the state so far if a stop was requested."""
        if cloud is None:
            return None
        settings = adapted(plan.settings, prior.volumes.slices.n_stacks)
        widths, n_steps = held_out.widths if held_out else None, settings.slice_stage.n_steps

        def fit() -> SliceFit:
            target = slice_target(prior, poses.weight, settings.slice_model, widths)
            return fit_lattices(
                cloud,
                prior,
                target,
                settings.n_lattices,
                weight=poses.weight,
                distillation=settings.use_prior and settings.distillation,
                prior_stage=settings.prior_stage,
                slice_stage=settings.slice_stage,
                context=self._context(Stage.FIT_TO_SLICES, settings.seed, run.deadline(plan.for_fit_to_slices()), run),
            )

        return run.stoppable_stage(Stage.FIT_TO_SLICES, fit, lambda result: (len(result.history), n_steps))

    def _context(self, stage: Stage, seed: int, deadline: Deadline | None, run: RunContext) -> FitContext:
        """Random numbers, progress, deadline and observer of a stage of the fit."""
        rng, progress = stage_rng(seed, stage), run.report(stage)
        return FitContext(rng=rng, progress=progress, deadline=deadline, observer=self.observer)
