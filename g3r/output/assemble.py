"""From the stages of a run to its result: the volume, its maps and the record, of a whole run or a partial one."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from g3r.acquisition.slicing import by_headers
from g3r.errors import NumericalError
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.lattice_mean import mean_cloud
from g3r.fitting.slice_stage import SliceFit
from g3r.geometry.grid import on_grid
from g3r.output.mixture import FinishedVolume, Mixture
from g3r.output.record import RegistrationRecord, RunRecord, inactive_terms
from g3r.output.result import ReconstructionResult
from g3r.output.stack_record import stack_records
from g3r.output.stage_results import StageResults
from g3r.output.written_volume import checked, corrected, least_weight, masks_on
from g3r.planning.anatomy import FETAL_BRAIN, NAME_OF, NOTE_ON_OTHERS
from g3r.planning.plan import Plan
from g3r.planning.presets import ReconstructionSettings, adapted
from g3r.planning.stages import Stage, stage_rng
from g3r.registration.quality import (
    left_out_notes,
    parallel_warnings,
    pose_warnings,
    registration_reliable,
    stack_qualities,
)
from g3r.registration.stack_quality import StackQuality
from g3r.run.allocator import release_memory
from g3r.run.context import RunContext
from g3r.run.machine import peak_bytes
from g3r.uncertainty import UncertaintyInputs, estimate_uncertainty
from g3r.uncertainty.estimate import prior_share_summary
from g3r.uncertainty.prior_share import estimate_prior_share
from g3r.uncertainty.unseen import UnseenPart

logger = logging.getLogger(__name__)

PARTIAL_NOTE = "interrupted: the volume so far; no uncertainty and no share of the prior were estimated"
UNFITTED_NOTE = "no fit was made: no uncertainty and no share of the prior were estimated"


def assemble(found: StageResults, plan: Plan, run: RunContext) -> ReconstructionResult:
    """The result of a run; the best volume so far, without its maps, where the run was stopped.

    Args:
        found: what the stages gave.
        plan: settings as they were used.
        run: clock, notes and warnings; says whether the run was stopped.

    Raises:
        NumericalError: the volume is not finite.
    """
    settings, volumes = plan.settings, found.prior.volumes
    qualities = stack_qualities(found.registration, len(found.stacks))
    run.notes += left_out_notes(qualities, found.stacks)
    run.warnings += pose_warnings(found.registration, qualities, found.stacks)
    run.warnings += parallel_warnings(found.registration.slices)
    grid = volumes.grid.respaced(settings.resolution_mm)
    cloud = mean_cloud(fit := found.fit or found.no_fit())
    uncertainty, prior_share, uncertainty_record = None, None, None
    with run.timed(Stage.VOLUME) as tell:
        mask, support, edge = masks_on(grid, found.prior, fit)
        least = least_weight(fit, float(mask.sum()) * grid.voxel_volume_mm3, settings, run)
        mixture = Mixture(
            grid=grid,
            support=support,
            prior=found.prior.values,
            density=volumes.density,
            prior_grid=volumes.grid,
            least_weight=least,
            edge=edge,
            cutoff_sigma=settings.slice_stage.cutoff_sigma,
        )
        volume, seen = mixture.volume(cloud, grid), mixture.seen(grid)
        if not np.isfinite(volume).all():
            raise NumericalError("the volume holds values that are not finite; lower the step sizes")
        check = checked(volume, mixture, found, fit) if settings.use_prior else None
        if check is not None and check.falls_back:
            mixture = replace(mixture, least_weight=1.0)
            volume = mixture.volume(cloud, grid)
        # errors are calibrated on what the fit gives; the correction takes a little of them away
        mixed, correction = volume, corrected(volume, cloud, mixture, found, settings, run)
        if correction is not None:
            mixture = replace(mixture, correction=correction.values)
            volume = mixture.corrected(mixed, grid)
        unseen = mask & ~seen
        unseen_part = UnseenPart.of(
            unseen,
            mask,
            grid.voxel_volume_mm3,
            shown=_shown_unseen(found.prior, settings),
            share_by_areas=_share_by_areas(found, settings),
            has_template=found.prior.has_template,
            what=NAME_OF[settings.anatomy],
        )
        tell(FinishedVolume(volume=volume, mask=mask, grid=grid, unseen=unseen_part))
    run.warnings += [line for line in (check.line() if check else "", unseen_part.line()) if line]
    run.notes += [NOTE_ON_OTHERS] if settings.anatomy != FETAL_BRAIN else []
    if run.stopped_at or not settings.n_lattices:
        run.notes.append(PARTIAL_NOTE if run.stopped_at else UNFITTED_NOTE)
    else:
        if settings.use_prior:
            with run.timed(Stage.PRIOR_SHARE):
                prior_share = estimate_prior_share(
                    fit,
                    density=volumes.density,
                    density_grid=volumes.grid,
                    mask=mask,
                    grid=grid,
                    rng=stage_rng(settings.seed, Stage.PRIOR_SHARE),
                    n_probes=settings.share_probes,
                    cutoff_sigma=settings.slice_stage.cutoff_sigma,
                    projection_bytes=settings.slice_stage.projection_bytes,
                )
                left = mixture.left_to_prior(grid)
                prior_share = np.where(unseen, 1, left + (1 - left) * prior_share).astype(np.float32)
                release_memory()
        with run.timed(Stage.UNCERTAINTY):
            estimated = estimate_uncertainty(
                UncertaintyInputs(
                    volume=mixed,
                    mask=mask,
                    grid=grid,
                    fit=fit,
                    prior=found.prior.values,
                    density=volumes.density,
                    prior_grid=volumes.grid,
                    prior_share=prior_share,
                    cutoff_sigma=settings.slice_stage.cutoff_sigma,
                ),
                with_prior=settings.use_prior,
                intensity=found.intensity,
                reliable=registration_reliable(qualities),
            )
        uncertainty, uncertainty_record = estimated.expected_error, estimated.record
        if correction is not None and prior_share is not None:
            prior_share = np.where(unseen, 1, prior_share * on_grid(correction.kept, volumes.grid, grid, outside=1.0))
            uncertainty_record |= {"prior_share": prior_share_summary(prior_share[mask])}
    intensity = np.float32(found.intensity)
    if not settings.fill_unseen:
        volume, mask = volume * seen, mask & ~unseen
        uncertainty = None if uncertainty is None else uncertainty * ~unseen
    return ReconstructionResult(
        volume=volume * intensity,
        mask=mask,
        unseen=unseen,
        support=support,
        edge=edge,
        grid=grid,
        prior=found.prior.values * intensity,
        coarse=volumes.coarse * intensity,
        density=volumes.density,
        prior_grid=volumes.grid,
        correction=mixture.correction,
        cloud=cloud,
        intensity_scale=found.intensity,
        slices=by_headers(fit.slices, found.stacks),
        gain=fit.gain,
        weight=fit.weight,
        ncc=found.registration.ncc,
        uncertainty=uncertainty,
        prior_share=prior_share,
        stacks=tuple(found.stacks),
        record=replace(
            _record(found, fit, qualities, plan, run, uncertainty_record),
            unseen=unseen_part,
            prior_weight=mixture.least_weight,
            volume_check=check,
            voxel_correction=correction.record if correction else None,
        ),
    )


def _shown_unseen(prior: PriorVolume, settings: ReconstructionSettings) -> str:
    """What the volume shows where no slice looked, in words."""
    if not settings.fill_unseen:
        return "blank"
    return "estimate from other brains" if prior.has_template else "smooth continuation"


def _share_by_areas(found: StageResults, settings: ReconstructionSettings) -> float | None:
    """What a single stack that is cut lacks of the head, by the areas of its slices; None where there is none.

    Of another object the part in the masks is meant, wherever it ends.
    """
    profiles = found.registration.profiles
    if settings.anatomy != FETAL_BRAIN or len(profiles) != 1 or not profiles[0].is_cut:
        return None
    return profiles[0].missing_share


def _record(
    found: StageResults,
    fit: SliceFit,
    qualities: Sequence[StackQuality],
    plan: Plan,
    run: RunContext,
    uncertainty: dict[str, Any] | None,
) -> RunRecord:
    settings, slices = plan.settings, found.prior.volumes.slices
    n_rollbacks = sum("rollback" in entry for entry in fit.history)
    if n_rollbacks:
        run.warnings.append(
            f"the loss of the fit rose: {n_rollbacks} times it went back to its best state and on "
            "with shorter steps; look at the volume"
        )
    for warning in run.warnings:
        logger.warning(warning)
    return RunRecord(
        settings=settings,
        time_budget=plan.record(),
        prior=found.prior_record,
        pose_network=found.pose_record,
        stacks=stack_records(found.stacks, found.registration, qualities, fit.weight, fit.slices),
        registration=RegistrationRecord.of(found.registration, qualities, fit.slices),
        stack_fields=found.stack_fields,
        bias_field=fit.bias_field,
        common_bias_rms=found.prior.volumes.field_rms,
        n_gaussians=len(fit.cloud) + sum(len(cloud) for cloud in fit.further),
        pose_rounds=found.rounds,
        held_out=found.held_out,
        gaussian_spacing_mm=found.cloud.spacing_mm if found.cloud else None,
        n_rollbacks=n_rollbacks,
        inactive_terms=inactive_terms(slices, adapted(settings, slices.n_stacks)),
        loss={Stage.FIT_TO_PRIOR: found.cloud.history if found.cloud else [], Stage.FIT_TO_SLICES: list(fit.history)},
        uncertainty=uncertainty,
        seconds=run.clock.seconds,
        cpu_seconds=run.clock.cpu_seconds,
        peak_memory_bytes=peak_bytes(),
        resumed=run.store.resumed,
        partial=run.stopped_at is not None,
        stopped_at=run.stopped_at,
        notes=run.notes,
        warnings=run.warnings,
    )
