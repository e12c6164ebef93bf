"""The steps to the written volume: masks, weight of V_prior, check and correction by the slices."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.mask_votes import foreground
from g3r.errors import NumericalError
from g3r.fitting.edge_by_image import shown_by_image
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.prior_weight import ended_early, noise_of, prior_weight
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.slice_targets import slice_target
from g3r.fitting.volume_check import VolumeCheck, check_volume
from g3r.fitting.voxel_correction import VoxelCorrection, correct_on_voxels
from g3r.fitting.voxel_problem import too_fine
from g3r.gaussians import GaussianCloud
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.output.mixture import INSIDE, Mixture
from g3r.output.stage_results import StageResults
from g3r.planning.presets import ReconstructionSettings, adapted
from g3r.planning.stages import Stage, stage_rng
from g3r.run.context import RunContext


@dataclass(frozen=True, kw_only=True)
class WrittenVolume:
    """The volume as written, in intensities of the fit, with its masks and intermediate results.

    Attributes:
        volume: float32 [I, J, K].
        mask: bool [I, J, K], brain mask.
        support: bool [I, J, K], where the volume is shown.
        edge: float16 [I, J, K], factor by which the support fades.
        edge_by_image: whether the edge follows from slices that are black beside the brain, not from masks alone.
        seen: bool [I, J, K], voxels that slices saw.
        unseen: bool [I, J, K], brain voxels that no slice saw.
        grid: grid of all these.
        mixture: mixture of Gaussians, V_prior and the correction.
        check: the volume compared with those before the fit; None without a prior.
        correction: correction by the slices; None without one.
    """

    volume: NDArray[np.float32]
    mask: NDArray[np.bool_]
    support: NDArray[np.bool_]
    edge: NDArray[np.float16]
    edge_by_image: bool
    seen: NDArray[np.bool_]
    unseen: NDArray[np.bool_]
    grid: VolumeGrid
    mixture: Mixture
    check: VolumeCheck | None
    correction: VoxelCorrection | None


def written_volume(
    cloud: GaussianCloud, fit: SliceFit, found: StageResults, settings: ReconstructionSettings, run: RunContext
) -> WrittenVolume:
    """The volume of a cloud on the output grid.

    Args:
        cloud: mean of the fit's lattices.
        fit: fit to the slices, or its stand-in if there was none.
        found: results of the stages.
        settings: as used.
        run: takes notes.

    Raises:
        NumericalError: the volume is not finite.
    """
    prior, volumes = found.prior, found.prior.volumes
    grid = volumes.grid.respaced(settings.resolution_mm)
    mask, support, edge = masks_on(grid, prior, fit)
    mixture = Mixture(
        grid=grid,
        support=support,
        prior=prior.values,
        density=volumes.density,
        prior_grid=volumes.grid,
        least_weight=least_weight(fit, float(mask.sum()) * grid.voxel_volume_mm3, settings, run),
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
    correction = corrected(volume, cloud, mixture, found, settings, run)
    if correction is not None:
        mixture = replace(mixture, correction=correction.values)
        volume = mixture.corrected(volume, grid)
    shown = shown_by_slices(volume, mixture, found, fit)
    if shown is not None:
        mixture = replace(mixture, edge=(edge * shown).astype(edge.dtype))
        before, after = edge.astype(np.float32), mixture.edge.astype(np.float32)
        left = np.divide(after, before, out=np.zeros_like(volume), where=before > 0)
        volume = volume * left
    return WrittenVolume(
        volume=volume,
        mask=mask,
        support=support,
        edge=mixture.edge,
        edge_by_image=shown is not None,
        seen=seen,
        unseen=mask & ~seen,
        grid=grid,
        mixture=mixture,
        check=check,
        correction=correction,
    )


def masks_on(
    grid: VolumeGrid, prior: PriorVolume, fit: SliceFit
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float16]]:
    """Brain mask, support and edge on the output grid; from the slices of the fit if it is not the prior's grid."""
    if grid is prior.volumes.grid:
        return prior.mask, prior.support, prior.volumes.foreground.edge(prior.support, prior.mask, prior.brain)
    if not len(fit.cloud):
        # the slices are as registration left them, so the masks on the prior's grid hold on this one
        mask, support = (
            on_grid(one.astype(np.float32), prior.volumes.grid, grid, outside=0.0) >= INSIDE
            for one in (prior.mask, prior.support)
        )
        faded = prior.volumes.foreground.edge(prior.support, prior.mask, prior.brain)
        edge = on_grid(faded, prior.volumes.grid, grid, outside=0.0)
        return mask, support, np.maximum(edge, mask).astype(np.float16)
    brain = prior.brain
    likely = None if brain is None else on_grid(brain, prior.volumes.grid, grid, outside=0.0)
    found = foreground(fit.slices, grid, fit.weight)
    mask, support = found.mask(likely), found.support(likely)
    return mask, support, found.edge(support, mask, likely)


def shown_by_slices(
    volume: NDArray[np.float32], mixture: Mixture, found: StageResults, fit: SliceFit
) -> NDArray[np.float32] | None:
    """Share of the volume that is shown, by slices that are black beside the brain; None for others or without a fit.

    None for a single stack, whose slices may lie a millimetre off. Unseen voxels are left as they are.
    """
    if found.fit is None or fit.slices.n_stacks == 1:
        return None
    grid = mixture.grid
    shown = shown_by_image(volume, mixture.edge, mixture.support, grid, fit, found.prior.volumes.slices)
    return None if shown is None else np.where(mixture.seen(grid), shown, 1).astype(np.float32)


def least_weight(fit: SliceFit, brain_mm3: float, settings: ReconstructionSettings, run: RunContext) -> float:
    """Least weight of V_prior in the volume; 0 without a prior, 1 if the fit had no time."""
    if not settings.use_prior:
        return 0.0
    if settings.prior_weight > 0 and ended_early(n_steps := len(fit.history), settings.slice_stage.n_steps):
        run.notes.append(f"the fit ended after {n_steps} steps: the volume is the prior volume alone")
        return 1.0
    return prior_weight(settings.prior_weight, fit.slices, fit.weight, brain_mm3, noise_of(fit))


def checked(volume: NDArray[np.float32], mixture: Mixture, found: StageResults, fit: SliceFit) -> VolumeCheck:
    """The volume compared with V_prior and V_coarse, the volumes before the fit."""
    before, grid, none = found.prior.volumes, mixture.grid, found.no_fit().cloud
    return check_volume(
        volume,
        mixture.volume(none, grid),
        replace(mixture, prior=before.coarse).volume(none, grid),
        support=mixture.support,
        grid=grid,
        slices=fit.slices,
        slices_before=before.slices,
        weight=fit.weight,
    )


def corrected(
    volume: NDArray[np.float32],
    cloud: GaussianCloud,
    mixture: Mixture,
    found: StageResults,
    settings: ReconstructionSettings,
    run: RunContext,
) -> VoxelCorrection | None:
    """The correction of a volume with Gaussians; None if not asked for or impossible, or if the run was stopped."""
    fit, prior = found.fit, found.prior
    asked = adapted(settings, prior.volumes.slices.n_stacks).voxel_correction
    if asked is None or fit is None or run.stopped_at is not None or mixture.least_weight == 1:
        return None
    if too_fine(float(mixture.prior_grid.spacing_mm.min()), fit.slices):
        return None
    widths = found.held_out.widths if found.held_out else None
    target = slice_target(prior, found.registration.weight, settings.slice_model, widths)
    here = volume if mixture.grid is mixture.prior_grid else mixture.volume(cloud, mixture.prior_grid)
    of_one_fit = mixture.volume(fit.cloud, mixture.prior_grid) if fit.further else here
    rng = stage_rng(settings.seed, Stage.VOLUME)
    reach = mixture.reach()
    return correct_on_voxels(here, of_one_fit, fit, target.pixel_weight, mixture.prior_grid, reach, asked, rng)
