"""The prior volume in both stages of the fit: Gaussians are seeded in it and fitted to it, and later held to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coarse_volume import confidence
from g3r.fitting.fit_context import FitContext
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.prior_stage import PriorCloud, PriorStageSettings, VolumeTarget, fit_prior
from g3r.gaussians.seeding import seed_cloud

MIN_DISTILLATION = 1e-3
"""Smallest weight of the prior, where slices are dense; above zero so that every voxel of the head has a weight."""


def fit_to_prior(
    prior: PriorVolume,
    *,
    spacing_mm: float,
    stage: PriorStageSettings,
    context: FitContext,
    shift: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
) -> PriorCloud:
    """Gaussians seeded in the prior volume and fitted to it (G3R Eq. 8).

    Args:
        prior: V_prior on its grid.
        spacing_mm: of the lattice of Gaussians.
        stage: how the fit runs.
        context: random numbers, progress, deadline and observer.
        shift: [3] of the lattice; see `seed_cloud`.
    """
    grid = prior.volumes.grid
    seeds = seed_cloud(prior.values, prior.support, grid, spacing_mm, shift)
    target = VolumeTarget.of(prior.values, prior.support.astype(np.float32), grid)
    cloud, history = fit_prior(seeds, target, stage, context)
    return PriorCloud(cloud, history, spacing_mm)


def distillation_target(prior: PriorVolume) -> VolumeTarget:
    """The prior volume with the weight of each voxel in the fit to the slices (the last term of G3R Eq. 9).

    The prior counts where slices are sparse; where they are dense, they determine the volume better. It was made of the
    same slices: with several stacks only 1 - c of what it shows in a voxel is its own, so the weight is (1 - c)^2. The
    density is that of the masked pixels, the only ones that the fit sees.
    """
    volumes = prior.volumes
    power = 1 if volumes.slices.n_stacks == 1 else 2
    unmeasured = np.maximum((1 - confidence(volumes.masked_density)) ** power, MIN_DISTILLATION)
    return VolumeTarget.of(prior.values, (unmeasured * prior.support).astype(np.float32), volumes.grid)
