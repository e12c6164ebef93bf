"""The mean of several fits to the slices, each with Gaussians on a lattice of its own.

The errors of a fit depend in part on where its Gaussians happened to lie. Fits on lattices that are shifted against
each other, and a little closer or wider, err differently, and their mean errs less. The mean is a cloud as well: all
Gaussians together, with amplitudes divided by the number of fits.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g3r.fitting.fit_context import FitContext
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.prior_stage import PriorCloud, PriorStageSettings
from g3r.fitting.prior_targets import distillation_target, fit_to_prior
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings, fit_slices
from g3r.fitting.slice_targets import SliceTarget
from g3r.gaussians import GaussianCloud
from g3r.run.deadline import timed_steps
from g3r.run.on_demand import torch
from g3r.run.progress import no_progress

SPACINGS = (1.0, 0.9, 1.1)
"""Spacings of the lattices in turn, over the spacing of the first."""

SHIFT = (0.8192, 0.6710, 0.5497)
"""Shift from one lattice to the next, in edges of its cell: the fractional parts of its multiples fill a cube evenly
(powers of the root of x^4 = x + 1; Roberts, The unreasonable effectiveness of quasirandom sequences, 2018)."""


def fit_lattices(
    first: PriorCloud,
    prior: PriorVolume,
    target: SliceTarget,
    n_lattices: int,
    *,
    weight: NDArray[np.float64],
    distillation: bool,
    prior_stage: PriorStageSettings,
    slice_stage: SliceStageSettings,
    context: FitContext,
) -> SliceFit:
    """The first fit to the slices, together with the clouds of fits on further lattices.

    Args:
        first: Gaussians fitted to the prior volume, where the first fit starts.
        prior: volume in which the others are seeded.
        target: the slices.
        n_lattices: fits in all.
        weight: [K] slice weights, from registration.
        distillation: whether the prior holds the fits (Eq. 9).
        prior_stage: how the Gaussians of further lattices are fitted to the prior.
        slice_stage: how a fit to the slices runs.
        context: random numbers, progress over all fits, deadline, and observer of the first. No further fit begins that
            would probably end after the deadline. A fit in which the run is stopped is dropped, except the first.

    Raises:
        NumericalError: see `fit_slices`.
    """
    held = distillation_target(prior) if distillation else None
    n_steps = n_lattices * slice_stage.n_steps

    def fit(number: int) -> SliceFit:
        start = first
        if number:
            start = fit_to_prior(
                prior,
                spacing_mm=first.spacing_mm * SPACINGS[number % len(SPACINGS)],
                stage=prior_stage,
                context=replace(context, progress=no_progress, observer=None),
                shift=np.modf(number * np.array(SHIFT))[0],
            )
        return fit_slices(
            start.cloud,
            target.slices,
            gain=prior.gain,
            weight=weight,
            prior=held,
            settings=slice_stage,
            context=replace(
                context,
                progress=lambda done, total: context.progress(number * total + done, n_steps),
                observer=None if number else context.observer,
            ),
            pixel_weight=target.pixel_weight,
        )

    fits: list[SliceFit] = []
    for number, _ in timed_steps(n_lattices, context.deadline):
        made = fit(number)
        if fits and context.deadline is not None and context.deadline.is_stopped():
            break
        fits.append(made)
    fits = fits or [fit(0)]  # stopped before the first: a fit without steps, which records that
    return replace(fits[0], further=tuple(one.cloud for one in fits[1:]))


def mean_cloud(fit: SliceFit) -> GaussianCloud:
    """The mean of the clouds of a fit as one cloud: all Gaussians, with amplitudes divided by the number of clouds."""
    if not fit.further:
        return fit.cloud
    clouds = (fit.cloud, *fit.further)
    together = [torch.cat(parts) for parts in zip(*(cloud.parameters for cloud in clouds), strict=True)]
    return GaussianCloud.of([*together[:3], together[3] / len(clouds)], fit.cloud.origin_mm)
