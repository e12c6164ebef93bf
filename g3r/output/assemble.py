"""The result of a run from its stages: the volume, its maps and the record, of a whole run or a partial one."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from g3r.acquisition.intensity_levels import gain_in_files
from g3r.acquisition.slicing import by_headers
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.lattice_mean import mean_cloud
from g3r.fitting.slice_stage import SliceFit
from g3r.output.maps import VolumeMaps, estimate_maps
from g3r.output.mixture import FinishedVolume
from g3r.output.record import LOSS_ROSE, RegistrationRecord, RunRecord, inactive_terms
from g3r.output.result import ReconstructionResult
from g3r.output.stack_record import stack_records
from g3r.output.stage_results import StageResults
from g3r.output.written_volume import WrittenVolume, written_volume
from g3r.planning.anatomy import FETAL_BRAIN, NAME_OF, NOTE_ON_OTHERS
from g3r.planning.plan import Plan
from g3r.planning.presets import ReconstructionSettings, adapted
from g3r.planning.stages import Stage
from g3r.registration.quality import (
    left_out_notes,
    parallel_warnings,
    pose_warnings,
    registration_reliable,
    stack_qualities,
)
from g3r.registration.stack_quality import StackQuality
from g3r.run.context import RunContext
from g3r.run.machine import peak_bytes
from g3r.uncertainty.unseen import UnseenPart

logger = logging.getLogger(__name__)

PARTIAL_NOTE = "interrupted: the volume so far; no uncertainty and no share of the prior were estimated"
UNFITTED_NOTE = "no fit was made: no uncertainty and no share of the prior were estimated"


def assemble(found: StageResults, plan: Plan, run: RunContext) -> ReconstructionResult:
    """The result of a run; if the run was stopped, the best volume so far without its maps.

    Args:
        found: results of the stages.
        plan: settings as used.
        run: clock, notes and warnings; knows whether the run was stopped.

    Raises:
        NumericalError: the volume is not finite.
    """
    settings = plan.settings
    qualities = stack_qualities(found.registration, len(found.stacks))
    run.notes += left_out_notes(qualities, found.stacks)
    run.warnings += pose_warnings(qualities, found.stacks)
    run.warnings += parallel_warnings(found.registration.slices)
    fit = found.fit or found.no_fit()
    with run.timed(Stage.VOLUME) as tell:
        written = written_volume(mean_cloud(fit), fit, found, settings, run)
        unseen = _unseen_part(written, found, settings)
        tell(FinishedVolume(volume=written.volume, mask=written.mask, grid=written.grid, unseen=unseen))
    run.warnings += [line for line in (written.check.line() if written.check else "", unseen.line()) if line]
    run.notes += [NOTE_ON_OTHERS] if settings.anatomy != FETAL_BRAIN else []
    maps = VolumeMaps()
    if run.stopped_at or not settings.n_lattices:
        run.notes.append(PARTIAL_NOTE if run.stopped_at else UNFITTED_NOTE)
    else:
        maps = estimate_maps(written, fit, found, settings, run, reliable=registration_reliable(qualities))
    run.warnings += rollback_warnings(fit.n_rollbacks)
    for warning in run.warnings:
        logger.warning(warning)
    record = replace(
        _record(found, fit, qualities, plan, run, maps),
        unseen=unseen,
        prior_weight=written.mixture.least_weight,
        volume_check=written.check,
        voxel_correction=written.correction.record if written.correction else None,
        edge_by_image=written.edge_by_image,
    )
    return _result(found, fit, written, maps, record, fill_unseen=settings.fill_unseen)


def _result(
    found: StageResults,
    fit: SliceFit,
    written: WrittenVolume,
    maps: VolumeMaps,
    record: RunRecord,
    *,
    fill_unseen: bool,
) -> ReconstructionResult:
    """The result in the intensities of the stacks.

    Args:
        found: results of the stages.
        fit: to the slices, or in place of one.
        written: the volume as shown.
        maps: what was estimated of it.
        record: of the run.
        fill_unseen: False leaves zeros where no slice looked.
    """
    volumes, intensity = found.prior.volumes, np.float32(found.intensity)
    volume, mask, uncertainty = written.volume, written.mask, maps.uncertainty
    if not fill_unseen:
        volume, mask = volume * written.seen, mask & ~written.unseen
        uncertainty = None if uncertainty is None else uncertainty * ~written.unseen
    return ReconstructionResult(
        volume=volume * intensity,
        mask=mask,
        unseen=written.unseen,
        support=written.support,
        edge=written.edge,
        grid=written.grid,
        prior=found.prior.values * intensity,
        coarse=volumes.coarse * intensity,
        density=volumes.density,
        prior_grid=volumes.grid,
        correction=written.mixture.correction,
        cloud=mean_cloud(fit),
        intensity_scale=found.intensity,
        slices=by_headers(fit.slices, found.stacks),
        gain=gain_in_files(fit.gain, fit.slices, found.stacks),
        weight=fit.weight,
        ncc=found.registration.ncc,
        uncertainty=uncertainty,
        prior_share=maps.prior_share,
        stacks=tuple(found.stacks),
        record=record,
    )


def rollback_warnings(n_rollbacks: int) -> list[str]:
    """A line about the times that the fit to the slices went back to its best state; none if it never did."""
    if not n_rollbacks:
        return []
    back = f"{n_rollbacks} times it went back to its best state and on with shorter steps"
    return [f"{LOSS_ROSE}: {back}; look at the volume"]


def _unseen_part(written: WrittenVolume, found: StageResults, settings: ReconstructionSettings) -> UnseenPart:
    """The unseen part of the brain, with the words for what is shown there."""
    return UnseenPart.of(
        written.unseen,
        written.mask,
        written.grid.voxel_volume_mm3,
        shown=_shown_unseen(found.prior, settings),
        share_by_areas=_share_by_areas(found, settings),
        has_template=found.prior.has_template,
        what=NAME_OF[settings.anatomy],
    )


def _shown_unseen(prior: PriorVolume, settings: ReconstructionSettings) -> str:
    """Words for the content of unseen voxels."""
    if not settings.fill_unseen:
        return "blank"
    return "estimate from other brains" if prior.has_template else "smooth continuation"


def _share_by_areas(found: StageResults, settings: ReconstructionSettings) -> float | None:
    """The missing share of the head, by the areas of slices; None unless there is a single stack and it is cut.

    None also for other anatomies, whose object is the part in the masks, wherever it ends.
    """
    profiles = found.registration.profiles
    if settings.anatomy != FETAL_BRAIN or len(profiles) != 1:
        return None
    return profiles[0].cut_share


def _record(
    found: StageResults, fit: SliceFit, qualities: Sequence[StackQuality], plan: Plan, run: RunContext, maps: VolumeMaps
) -> RunRecord:
    settings, slices = plan.settings, found.prior.volumes.slices
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
        n_rollbacks=fit.n_rollbacks,
        inactive_terms=inactive_terms(slices, adapted(settings, slices.n_stacks)),
        loss={Stage.FIT_TO_PRIOR: found.cloud.history if found.cloud else [], Stage.FIT_TO_SLICES: list(fit.history)},
        uncertainty=maps.record,
        seconds=run.clock.seconds,
        cpu_seconds=run.clock.cpu_seconds,
        peak_memory_bytes=peak_bytes(),
        resumed=run.store.resumed,
        partial=run.stopped_at is not None,
        stopped_at=run.stopped_at,
        notes=run.notes,
        warnings=run.warnings,
    )
