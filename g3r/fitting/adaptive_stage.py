"""Stage 1 with as many Gaussians as an error bound asks for: few large ones first, more where they fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import volume_from_pixels
from g3r.fitting.prior_stage import NO_PROGRESS, PriorStageSettings, VolumeTarget, fit_prior, solve_amplitudes_on
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.densification import (
    concatenated,
    exceeds_density,
    find_extrema,
    local_rms,
    pruned,
    with_duplicates_merged,
)
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box
from g3r.run.deadline import Deadline

WINDOW_SHARE = 0.5
"""Sigma of the neighbourhood over which the residual is averaged, over the finest spacing."""

GROWTH = 1.7
"""Largest ratio of Gaussians after a round to those before it: new ones need the next fit to find their place."""

FILTER_SHARE = 0.2
"""Sigma of the filter that finds residual extrema, over the mean spacing of the Gaussians there are."""

MIN_SIGMA_SHARE = 0.25
"""Smallest sigma of a new Gaussian, over the finest spacing."""

PRUNE_TOLERANCE = 0.1
"""A Gaussian is pruned, and duplicates are merged, where that changes the volume by less than this times bound^2 in a
cell of the finest lattice."""


@dataclass(frozen=True, kw_only=True)
class AdaptiveSettings:
    """How the number of Gaussians is found.

    Args:
        bound: largest root mean square residual that is left in the neighbourhood of a voxel, in units of the volume,
            wherever Gaussians of the finest spacing can bring it there.
        start: spacing of the first lattice, over the finest.
        n_rounds: largest number of rounds of densification.
        round_steps: optimiser steps before each look at the residual.
        last_steps: and after the last; those of `PriorStageSettings` when None.
        amplitude_iterations: conjugate-gradient steps for the amplitudes at the start of each round, and at the end.
    """

    bound: float = 0.05
    start: float = 3.0
    n_rounds: int = 6
    round_steps: int = 45
    last_steps: int | None = None
    amplitude_iterations: int = 8


@dataclass(kw_only=True)
class Densification:
    """Record of the rounds that brought a cloud to the bound.

    Attributes:
        bound: as in the settings.
        n_seeded: Gaussians of the first lattice.
        n_added, n_merged, n_dropped: in all rounds; a merge takes one away.
        n_rounds: rounds that added Gaussians.
        steps: optimiser steps of all rounds.
        rms: root mean square of the final residual in the mask.
        share_over_bound: share of the mask in whose neighbourhood the final residual is over the bound.
        loss: image loss of each step.
    """

    bound: float
    n_seeded: int
    n_added: int = 0
    n_merged: int = 0
    n_dropped: int = 0
    n_rounds: int = 0
    steps: int = 0
    rms: float = 0.0
    share_over_bound: float = 0.0
    loss: list[float] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """Its figures, without the loss."""
        return {name: value for name, value in asdict(self).items() if name != "loss"}


def fit_adaptive(
    volume: NDArray[np.float32],
    mask: NDArray[np.bool_],
    grid: VolumeGrid,
    *,
    finest_spacing_mm: float,
    settings: AdaptiveSettings,
    stage: PriorStageSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] = NO_PROGRESS,
    deadline: Deadline | None = None,
) -> tuple[GaussianCloud, Densification]:
    """A cloud that shows a volume to within a bound, with few Gaussians (G3R Eq. 8 in rounds).

    A coarse lattice is fitted. Then, in rounds: Gaussians that hardly matter are pruned, duplicates are merged, and new
    ones are put on the extrema of the residual, shaped like it, largest gain first, where the residual is over the
    bound and Gaussians are not at the finest spacing already. The old ones stay and adjust in the fit that follows.

    Args:
        volume: [I, J, K], of order one.
        mask: [I, J, K], where the volume counts.
        grid: their grid.
        finest_spacing_mm: edge of the cell per Gaussian where they are closest.
        settings: bound and rounds.
        stage: how the optimiser runs.
        rng: draws the planes of the optimiser's steps.
        progress: called with (steps done, largest number of steps).
        deadline: fewer steps in each round if they would end after it.

    Raises:
        ValueError: an empty mask, or a bound that is not positive.
    """
    if not settings.bound > 0:
        raise ValueError(f"bound {settings.bound}; expected a positive number")
    if not mask.any():
        raise ValueError("the foreground is empty")
    box = bounding_box(mask)
    volume, mask, grid = np.ascontiguousarray(volume[box]), np.ascontiguousarray(mask[box]), grid.cropped(box)
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    last_steps = stage.n_steps if settings.last_steps is None else settings.last_steps
    at_most = settings.n_rounds * settings.round_steps + last_steps
    prune_tolerance = PRUNE_TOLERANCE * settings.bound**2 * finest_spacing_mm**3
    window_mm = WINDOW_SHARE * finest_spacing_mm
    cloud = seed_cloud(volume, mask, grid, settings.start * finest_spacing_mm)
    done = Densification(bound=settings.bound, n_seeded=len(cloud))

    def fitted(cloud: GaussianCloud, n_steps: int) -> GaussianCloud:
        before = done.steps
        run = replace(stage, n_steps=n_steps, amplitude_iterations=settings.amplitude_iterations)
        # the rounds to come take as many steps as they would without a deadline, of what time is left
        by_then = deadline.part(n_steps / max(1, at_most - before)) if deadline else None
        cloud, loss = fit_prior(
            cloud, target, run, rng, progress=lambda n, _: progress(before + n, at_most), deadline=by_then
        )
        done.steps += len(loss)
        done.loss += loss
        return cloud

    def left(cloud: GaussianCloud) -> NDArray[np.float32]:
        shown = render(cloud, target.planes, cutoff_sigma=stage.cutoff_sigma).detach().numpy()
        return volume_from_pixels((target.value - shown) * target.weight, grid)

    for _ in range(settings.n_rounds):
        cloud = fitted(cloud, settings.round_steps)
        residual = left(cloud)
        spacing_mm = (mask.sum() * grid.voxel_volume_mm3 / max(len(cloud), 1)) ** (1 / 3)
        filter_mm = max(FILTER_SHARE * spacing_mm, float(grid.spacing_mm.max()))
        extrema = find_extrema(residual, mask, grid, filter_mm, MIN_SIGMA_SHARE * finest_spacing_mm)
        over = local_rms(residual, mask, grid, window_mm) > settings.bound
        extrema = extrema.take(over[tuple(extrema.index.T)])
        extrema = extrema.take(~exceeds_density(cloud, grid.world(extrema.index), finest_spacing_mm))
        most = max(1, int((GROWTH - 1) * len(cloud)))
        extrema = extrema.take(np.sort(np.argsort(-extrema.gain, kind="stable")[:most]))
        if not len(extrema):
            break
        cloud = _thinned(cloud, prune_tolerance, done)
        cloud = concatenated(cloud, extrema.cloud(grid, cloud.origin_mm))
        done.n_added += len(extrema)
        done.n_rounds += 1
    cloud = _thinned(fitted(cloud, last_steps), prune_tolerance, done)
    cloud = solve_amplitudes_on(
        cloud, target, settings.amplitude_iterations, stage.cutoff_sigma, stage.projection_bytes
    )
    residual = left(cloud)
    done.rms = float(np.sqrt((residual[mask] ** 2).mean()))
    done.share_over_bound = float((local_rms(residual, mask, grid, window_mm)[mask] > settings.bound).mean())
    progress(at_most, at_most)
    return cloud, done


def _thinned(cloud: GaussianCloud, prune_tolerance: float, done: Densification) -> GaussianCloud:
    """The cloud pruned, with duplicates merged; both are counted in `done`."""
    kept = pruned(cloud, prune_tolerance)
    merged = with_duplicates_merged(kept, prune_tolerance)
    done.n_dropped += len(cloud) - len(kept)
    done.n_merged += len(kept) - len(merged)
    return merged
