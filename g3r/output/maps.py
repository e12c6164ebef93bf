"""The maps beside a volume: prior share and expected error of each voxel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.fitting.slice_stage import SliceFit
from g3r.geometry.grid import on_grid
from g3r.output.stage_results import StageResults
from g3r.output.written_volume import WrittenVolume
from g3r.planning.presets import ReconstructionSettings
from g3r.planning.stages import Stage, stage_rng
from g3r.run.allocator import release_memory
from g3r.run.context import RunContext
from g3r.uncertainty import UncertaintyInputs, estimate_uncertainty
from g3r.uncertainty.prior_share import estimate_prior_share


@dataclass(frozen=True, kw_only=True)
class VolumeMaps:
    """Maps of a volume, on its grid; None if they were not estimated.

    Attributes:
        uncertainty: float32 [I, J, K], expected error in units of the stacks.
        prior_share: float32 [I, J, K], from 0 to 1; also None without a prior.
        record: entries for run.json.
    """

    uncertainty: NDArray[np.float32] | None = None
    prior_share: NDArray[np.float32] | None = None
    record: dict[str, Any] | None = None


def estimate_maps(
    written: WrittenVolume,
    fit: SliceFit,
    found: StageResults,
    settings: ReconstructionSettings,
    run: RunContext,
    *,
    reliable: bool | None,
) -> VolumeMaps:
    """The maps of a volume.

    Args:
        written: the volume.
        fit: the fit that the volume was made from.
        found: results of the stages.
        settings: as used.
        run: times both stages.
        reliable: whether the registration is reliable; None if unknown.
    """
    prior_share = None
    shown = written.mask if settings.fill_unseen else written.mask & ~written.unseen
    if settings.use_prior:
        with run.timed(Stage.PRIOR_SHARE):
            prior_share = _mixed_share(written, fit, found, settings)
            if written.correction is not None:
                kept = on_grid(written.correction.kept, found.prior.volumes.grid, written.grid, outside=1.0)
                prior_share = np.where(written.unseen, 1, prior_share * kept)
            release_memory()
    with run.timed(Stage.UNCERTAINTY):
        estimated = estimate_uncertainty(
            UncertaintyInputs(
                volume=written.volume,
                mask=shown,
                grid=written.grid,
                fit=fit,
                prior=found.prior.values,
                density=found.prior.volumes.density,
                prior_grid=found.prior.volumes.grid,
                prior_share=prior_share,
                cutoff_sigma=settings.slice_stage.cutoff_sigma,
            ),
            with_prior=settings.use_prior,
            intensity=found.intensity,
            reliable=reliable,
        )
    return VolumeMaps(uncertainty=estimated.expected_error, prior_share=prior_share, record=estimated.record)


def _mixed_share(
    written: WrittenVolume, fit: SliceFit, found: StageResults, settings: ReconstructionSettings
) -> NDArray[np.float32]:
    """The prior's share of the mixed volume: through the Gaussians, and through its own weight in the mixture."""
    volumes = found.prior.volumes
    share = estimate_prior_share(
        fit,
        density=volumes.density,
        density_grid=volumes.grid,
        mask=written.mask,
        grid=written.grid,
        rng=stage_rng(settings.seed, Stage.PRIOR_SHARE),
        n_probes=settings.share_probes,
        cutoff_sigma=settings.slice_stage.cutoff_sigma,
        projection_bytes=settings.slice_stage.projection_bytes,
    )
    left = written.mixture.left_to_prior(written.grid)
    return np.where(written.unseen, 1, left + (1 - left) * share).astype(np.float32)
