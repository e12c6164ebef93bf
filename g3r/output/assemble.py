"""From a fit to a result: the volume, its maps and the record; or what there is when a run is cut short."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from g3r.acquisition.foreground import foreground_mask
from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.acquisition.stacks import Stack
from g3r.errors import NumericalError
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.output.record import inactive_terms, run_record
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import ReconstructionSettings
from g3r.planning.time_budget import TimeBudget
from g3r.pose_network.checkpoint import PoseCheckpoint
from g3r.prior.checkpoint import PriorCheckpoint
from g3r.registration import Registration
from g3r.registration.quality import StackQuality, registration_reliable
from g3r.run.allocator import release_memory
from g3r.run.stage_store import PriorCloud, PriorVolume, Stages, stage_rng
from g3r.uncertainty import UncertaintyInputs, estimate_uncertainty
from g3r.uncertainty.prior_share import estimate_prior_share

logger = logging.getLogger(__name__)

PARTIAL_NOTE = "interrupted: the volume so far; no uncertainty and no share of the prior were estimated"


@dataclass(frozen=True)
class Cut:
    """Where a run was interrupted."""

    stage: str
    step: int
    n_steps: int

    def __str__(self) -> str:
        return f"interrupted in {self.stage!r}, step {self.step} of {self.n_steps}"


@dataclass(frozen=True)
class RunSoFar:
    """What is known before the fit.

    Attributes:
        stacks: as they were given.
        settings: as they are used.
        prior_meta, pose_meta: of the networks; None where one is not used.
        motion: the registration, and what each stack's is worth.
        volume: the prior volume and what it was made of.
        intensity: what 1 stands for in the fit.
        stages: with the clock.
        budget: of time.
        notes, warnings: for run.json; both may grow.
    """

    stacks: Sequence[Stack]
    settings: ReconstructionSettings
    prior_meta: PriorCheckpoint | None
    pose_meta: PoseCheckpoint | None
    motion: Registration
    qualities: list[StackQuality]
    volume: PriorVolume
    intensity: float
    stages: Stages
    budget: TimeBudget | None
    notes: list[str]
    warnings: list[str]

    @property
    def grid(self) -> VolumeGrid:
        """Of the volume that is asked for."""
        prior_grid, resolution_mm = self.volume.start.grid, self.settings.resolution_mm
        if np.isclose(prior_grid.spacing_mm[0], resolution_mm, rtol=1e-6):
            return prior_grid
        low, high = prior_grid.world([0, 0, 0]), prior_grid.world(np.array(prior_grid.shape) - 1)
        return VolumeGrid.isotropic(low, high, resolution_mm)


def finished(run: RunSoFar, first: PriorCloud, fit: SliceFit) -> ReconstructionResult:
    """The result of a whole run.

    Args:
        run: what came before the fit.
        first: what stage 1 of the fit gave.
        fit: and stage 2.

    Raises:
        NumericalError: the volume is not finite.
    """
    settings, clock, start, grid = run.settings, run.stages.clock, run.volume.start, run.grid
    with clock("volume"):
        mask = _mask(run, fit, grid)
        volume = _rendered(fit.cloud, mask, grid, settings.slice_stage.cutoff_sigma)
    prior_share = None
    if settings.use_prior:
        with clock("prior share"):
            prior_share = estimate_prior_share(
                fit,
                density=start.density,
                density_grid=start.grid,
                mask=mask,
                grid=grid,
                rng=stage_rng(settings.seed, "prior share"),
                n_probes=settings.share_probes,
                cutoff_sigma=settings.slice_stage.cutoff_sigma,
                projection_bytes=settings.slice_stage.projection_bytes,
            )
            release_memory()
    with clock("uncertainty"):
        uncertainty = estimate_uncertainty(
            UncertaintyInputs(
                volume=volume,
                mask=mask,
                grid=grid,
                fit=fit,
                prior=run.volume.prior,
                density=start.density,
                prior_grid=start.grid,
                prior_share=prior_share,
                cutoff_sigma=settings.slice_stage.cutoff_sigma,
            ),
            with_prior=settings.use_prior,
            intensity=run.intensity,
            reliable=registration_reliable(run.qualities),
        )
    record = _record(run, first, fit) | {"partial": False, "uncertainty": uncertainty.record}
    return _result(run, fit, volume, mask, grid, record, uncertainty.expected_error, prior_share)


def cut_short(run: RunSoFar, cut: Cut, first: PriorCloud | None, fit: SliceFit | None) -> ReconstructionResult:
    """The best volume of a run that was interrupted: what stage 2 of the fit has so far, else the prior.

    Args:
        run: what came before the fit.
        cut: where it ended.
        first: what stage 1 gave; None while it ran: its Gaussians show the prior volume less well than that.
        fit: the state of stage 2; None before it.

    Raises:
        NumericalError: the volume is not finite.
    """
    grid, start = run.grid, run.volume.start
    if fit is None or first is None:
        first = PriorCloud(_no_gaussians(), [], {})
        fit = SliceFit(
            cloud=first.cloud,
            slices=start.slices,
            gain=run.volume.gain,
            weight=run.motion.weight,
            history=[],
            bias_field=[],
        )
        mask = _mask(run, fit, grid)
        volume = on_grid(run.volume.prior, start.grid, grid, outside=0.0) * mask
    else:
        mask = _mask(run, fit, grid)
        volume = _rendered(fit.cloud, mask, grid, run.settings.slice_stage.cutoff_sigma)
    run.notes.append(PARTIAL_NOTE)
    record = _record(run, first, fit) | {
        "partial": True,
        "interrupted": {"stage": cut.stage, "step": cut.step, "n_steps": cut.n_steps},
        "uncertainty": None,
    }
    return _result(run, fit, volume, mask, grid, record, None, None)


def _no_gaussians() -> GaussianCloud:
    empty = [torch.zeros(0, n) for n in (3, 3, 4)]
    return GaussianCloud.of([*empty, torch.zeros(0)], np.zeros(3))


def _mask(run: RunSoFar, fit: SliceFit, grid: VolumeGrid) -> NDArray[np.bool_]:
    start = run.volume.start
    return start.mask if grid is start.grid else foreground_mask(fit.slices, grid, fit.weight)


def _rendered(
    cloud: GaussianCloud, mask: NDArray[np.bool_], grid: VolumeGrid, cutoff_sigma: float
) -> NDArray[np.float32]:
    pixels = render(cloud, volume_planes(grid), cutoff_sigma=cutoff_sigma).numpy()
    volume = volume_from_pixels(pixels, grid) * mask
    if not np.isfinite(volume).all():
        raise NumericalError("the volume holds values that are not finite; lower the step sizes")
    return volume


def _record(run: RunSoFar, first: PriorCloud, fit: SliceFit) -> dict[str, Any]:
    settings, stages = run.settings, run.stages
    record = run_record(
        settings,
        run.prior_meta,
        run.pose_meta,
        run.stacks,
        run.volume.start.slices,
        run.motion,
        run.qualities,
        fit,
        stages.clock,
        run.notes,
        run.warnings,
    )
    record["resumed"] = stages.resumed
    record["time_budget"] = run.budget.record() if run.budget else None
    record["gaussians"] = first.counts | {"n_final": len(fit.cloud)}
    record["left_out"] = inactive_terms(run.volume.start.slices, settings, first.counts)
    record["loss"] = {"fit to prior": first.history, "fit to slices": fit.history}
    if record["n_rollbacks"]:
        run.warnings.append(
            f"the loss of the fit rose: {record['n_rollbacks']} times it went back to its best state and on "
            "with shorter steps; look at the volume"
        )
    for warning in run.warnings:
        logger.warning(warning)
    return record


def _result(
    run: RunSoFar,
    fit: SliceFit,
    volume: NDArray[np.float32],
    mask: NDArray[np.bool_],
    grid: VolumeGrid,
    record: dict[str, Any],
    uncertainty: NDArray[np.float32] | None,
    prior_share: NDArray[np.float32] | None,
) -> ReconstructionResult:
    start, intensity = run.volume.start, np.float32(run.intensity)
    return ReconstructionResult(
        volume * intensity,
        mask,
        grid,
        run.volume.prior * intensity,
        start.coarse * intensity,
        start.density,
        start.grid,
        fit.cloud,
        run.intensity,
        fit.slices,
        fit.gain,
        fit.weight,
        run.motion.ncc,
        uncertainty,
        prior_share,
        record,
    )
