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
from g3r.run.deadline import Deadline

WINDOW_SHARE = 0.5
"""Sigma of the neighbourhood in which the residual is judged, over the finest spacing."""


@dataclass(frozen=True)
class AdaptiveSettings:
    """How the number of Gaussians is found.

    Args:
        bound: largest root mean square residual that is left in the neighbourhood of a voxel, in units of
            the volume, wherever Gaussians of the finest spacing can bring it there.
        start: spacing of the first lattice, over the finest.
        growth: a round makes at most so many Gaussians of one.
        n_rounds: at most so many rounds.
        filter_share: sigma of the filter that finds blobs, over the mean spacing of the Gaussians there are.
        min_share: least sigma of a new Gaussian, over the finest spacing.
        prune_tolerance: a Gaussian is dropped, and a pair merged, where that changes the volume by less than so many
            times bound^2 in a cell of the finest lattice.
        round_steps: optimiser steps before each look at the residual.
        last_steps: and after the last; those of `PriorStageSettings` when None.
        amplitude_iterations: conjugate-gradient steps for the amplitudes at the start of each round, and at the end.
    """

    bound: float = 0.05
    start: float = 3.0
    growth: float = 1.7
    n_rounds: int = 6
    filter_share: float = 0.2
    min_share: float = 0.25
    prune_tolerance: float = 0.1
    round_steps: int = 45
    last_steps: int | None = None
    amplitude_iterations: int = 8


@dataclass
class Refinement:
    """What was done to a cloud on the way to the bound.

    Attributes:
        bound: that was asked for.
        n_seeded: Gaussians of the first lattice.
        n_added, n_merged, n_dropped: in all rounds; a merge takes one away.
        n_rounds: of adding.
        steps: optimiser steps, all rounds together.
        rms: root mean square of what is left, in the mask.
        share_over_bound: share of the mask in whose neighbourhood it is over the bound.
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
    finest_spacing_mm: float,
    settings: AdaptiveSettings,
    stage: PriorStageSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] = NO_PROGRESS,
    deadline: Deadline | None = None,
) -> tuple[GaussianCloud, Refinement]:
    """A cloud that shows a volume to within a bound, with few Gaussians.

    A coarse lattice is fitted. Then, in rounds: Gaussians that would not be missed go, pairs that one could
    stand for are merged, and new ones are put on the extrema of what is left, shaped like it, largest gain
    first - where the residual is over the bound and Gaussians do not stand at the finest spacing already.
    The old ones keep their place and give way in the fit that follows.

    Args:
        volume: [I, J, K], of order one.
        mask: [I, J, K], where the volume counts.
        grid: their grid.
        finest_spacing_mm: edge of the cell per Gaussian where they stand closest.
        settings: bound and rounds.
        stage: how the optimiser runs.
        rng: draws the planes of the optimiser's steps.
        progress: called with (steps done, steps in all at most).
        deadline: fewer steps in each round if they would end after it.

    Raises:
        ValueError: an empty mask, or a bound that is not positive.
    """
    if not settings.bound > 0:
        raise ValueError(f"bound {settings.bound}; expected a positive number")
    if not mask.any():
        raise ValueError("the foreground is empty")
    volume, mask, grid = _cropped(volume, mask, grid)
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    last_steps = stage.n_steps if settings.last_steps is None else settings.last_steps
    at_most = settings.n_rounds * settings.round_steps + last_steps
    prune_tolerance = settings.prune_tolerance * settings.bound**2 * finest_spacing_mm**3
    window_mm = WINDOW_SHARE * finest_spacing_mm
    cloud = seed_cloud(volume, mask, grid, settings.start * finest_spacing_mm)
    done = Refinement(settings.bound, len(cloud))

    def fitted(cloud: GaussianCloud, n_steps: int) -> GaussianCloud:
        before = done.steps
        run = replace(stage, n_steps=n_steps, amplitude_iterations=settings.amplitude_iterations)
        # the rounds to come take as many steps as they would without a deadline, of what time is left
        by_then = deadline.part(n_steps / max(1, at_most - before)) if deadline else None
        cloud, loss = fit_prior(cloud, target, run, rng, lambda n, _: progress(before + n, at_most), by_then)
        done.steps += len(loss)
        done.loss += loss
        return cloud

    def left(cloud: GaussianCloud) -> NDArray[np.float32]:
        shown = render(cloud, target.planes).detach().numpy()
        return volume_from_pixels((target.value - shown) * target.weight, grid)

    for _ in range(settings.n_rounds):
        cloud = fitted(cloud, settings.round_steps)
        residual = left(cloud)
        spacing_mm = (mask.sum() * grid.voxel_volume_mm3 / max(len(cloud), 1)) ** (1 / 3)
        filter_mm = max(settings.filter_share * spacing_mm, float(grid.spacing_mm.max()))
        blobs = find_extrema(residual, mask, grid, filter_mm, settings.min_share * finest_spacing_mm)
        over = local_rms(residual, mask, grid, window_mm) > settings.bound
        blobs = blobs.take(over[tuple(blobs.index.T)])
        blobs = blobs.take(~exceeds_density(cloud, grid.world(blobs.index), finest_spacing_mm))
        most = max(1, int((settings.growth - 1) * len(cloud)))
        blobs = blobs.take(np.sort(np.argsort(-blobs.gain, kind="stable")[:most]))
        if not len(blobs):
            break
        cloud = _thinned(cloud, prune_tolerance, done)
        cloud = concatenated(cloud, blobs.cloud(grid, cloud.origin_mm))
        done.n_added += len(blobs)
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


def _thinned(cloud: GaussianCloud, prune_tolerance: float, done: Refinement) -> GaussianCloud:
    """The cloud without what would not be missed; the counts are kept."""
    kept = pruned(cloud, prune_tolerance)
    merged = with_duplicates_merged(kept, prune_tolerance)
    done.n_dropped += len(cloud) - len(kept)
    done.n_merged += len(kept) - len(merged)
    return merged


def _cropped(
    volume: NDArray[np.float32], mask: NDArray[np.bool_], grid: VolumeGrid
) -> tuple[NDArray[np.float32], NDArray[np.bool_], VolumeGrid]:
    """Volume, mask and grid of the box around the mask."""
    inside = np.argwhere(mask)
    low, high = inside.min(0), inside.max(0) + 1
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    affine = grid.affine.copy()
    affine[:3, 3] = grid.world(low)
    shape = (int(high[0] - low[0]), int(high[1] - low[1]), int(high[2] - low[2]))
    return np.ascontiguousarray(volume[box]), np.ascontiguousarray(mask[box]), VolumeGrid(shape, affine)
