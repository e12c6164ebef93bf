"""Poses and volume in rounds: slices registered to the fitted volume, and the volume made anew from them.

Registration uses a least-squares volume that repeats the errors of its poses. The Gaussians start at V_prior, whose
network has learned what heads look like, and slices move with them: two stacks, which check each other only where they
cross, come nearer to the truth with every round. A round is kept unless stacks then predict each other clearly worse
(`MAX_LOSS`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices, volume_from_pixels, volume_planes
from g3r.acquisition.robust import robust_width, slice_weights
from g3r.fitting.fit_context import FitContext
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.fitting.prior_targets import distillation_target, fit_to_prior
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings, fit_slices
from g3r.fitting.slice_targets import SliceModel, slice_target
from g3r.gaussians import render
from g3r.gaussians.seeding import LatticeSpacing
from g3r.registration import Registration
from g3r.registration.held_out import fine_held_out_correlations
from g3r.registration.motion_shear import without_excess_shear
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.slice_registration import register_slices, try_neighbours
from g3r.registration.stray_slices import find_strays
from g3r.run.progress import Progress, no_progress

logger = logging.getLogger(__name__)

MAX_PIXELS = 200_000
"""Largest number of pixels, about, in a Gauss-Newton step."""

MAX_LOSS = 0.02
"""A round whose mean held-out correlation is lower than the highest so far by more than this is undone. It guards
against a round that goes astray; finer it does not tell: of about 30 pairs of simulated stacks with moving heads that
were in place, nearly all came nearer to the truth in every round, while this correlation changed by -0.014 to +0.11 (by
hand)."""


@dataclass(frozen=True, kw_only=True)
class PoseRoundSettings:
    """Numbers of rounds in which poses and volume are found in turn, and of their steps.

    Args:
        moves_to_prior: moves of the slices of one stack towards V_prior before its rounds, at most.
        single_stack: rounds with one stack, which nothing but the prior holds in place.
        two_stacks: rounds with two stacks.
        more_stacks: rounds with three stacks or more, whose poses are nearer to the truth without one.
        prior_steps, slice_steps: steps of both stages of the fit in a round.
        newton_steps: Gauss-Newton steps of all slices against the fitted volume.
    """

    moves_to_prior: int = 8
    single_stack: int = 1
    two_stacks: int = 2
    more_stacks: int = 0
    prior_steps: int = 12
    slice_steps: int = 110
    newton_steps: int = 4

    def n_rounds(self, n_stacks: int) -> int:
        """Largest number of rounds with a number of stacks."""
        return (self.single_stack, self.two_stacks, self.more_stacks)[min(n_stacks, 3) - 1]

    def at_most(self, n_rounds: int) -> PoseRoundSettings:
        """The settings with no more rounds than given."""
        counts = {name: min(getattr(self, name), n_rounds) for name in ("single_stack", "two_stacks", "more_stacks")}
        return replace(self, **counts)


@dataclass(frozen=True, kw_only=True)
class PoseRounds:
    """Record of the rounds.

    Attributes:
        n_kept: rounds that were kept.
        held_out: mean correlation of each stack with a volume of the others, before the first round and after each, the
            undone one included; empty for a single stack.
        n_moved: slices that took the motion of a neighbour or were found in another place, in each round.
    """

    n_kept: int
    held_out: list[float]
    n_moved: list[int]


@dataclass(frozen=True, kw_only=True)
class RefinedPoses:
    """Poses after all rounds, the prior volume that was made of them, and the record of the rounds."""

    registration: Registration
    prior: PriorVolume
    record: PoseRounds


@dataclass(frozen=True, kw_only=True)
class RoundFit:
    """The short fit of a round.

    Args:
        settings: its number of steps.
        lattice: spacing of its Gaussians.
        prior_stage, slice_stage: settings of the whole fit, with other numbers of steps.
        slice_model: of the slices.
        distillation: whether it is held to V_prior.
    """

    settings: PoseRoundSettings
    lattice: LatticeSpacing
    prior_stage: PriorStageSettings
    slice_stage: SliceStageSettings
    slice_model: SliceModel
    distillation: bool = True

    def run(self, prior: PriorVolume, weight: NDArray[np.float64], rng: np.random.Generator) -> SliceFit:
        """Gaussians and poses of a few steps.

        Args:
            prior: with the posed slices.
            weight: [K] slice weights.
            rng: draws what the fits draw.
        """
        spacing_mm = self.lattice.mm(prior.volumes.slices)
        stage, context = replace(self.prior_stage, n_steps=self.settings.prior_steps), FitContext(rng=rng)
        cloud = fit_to_prior(prior, spacing_mm=spacing_mm, stage=stage, context=context)
        target = slice_target(prior, weight, self.slice_model)
        return fit_slices(
            cloud.cloud,
            target.slices,
            gain=prior.gain,
            weight=weight,
            prior=distillation_target(prior) if self.distillation else None,
            settings=replace(self.slice_stage, n_steps=self.settings.slice_steps),
            context=context,
            pixel_weight=target.pixel_weight,
        )


def refine_in_rounds(
    registration: Registration,
    prior: PriorVolume,
    n_rounds: int,
    *,
    prior_of: Callable[[Registration, bool], PriorVolume],
    fit: RoundFit,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> RefinedPoses:
    """Poses and prior volume after up to `n_rounds` rounds; the first round that goes astray is the last.

    Args:
        registration: poses from the slices alone.
        prior: the prior volume made of them.
        n_rounds: at most.
        prior_of: makes the prior volume for poses; its second argument says whether it is the last one, which is worth
            more time.
        fit: of each round.
        rng: draws what the fits draw.
        progress: called with (rounds done, rounds in all).
    """
    checked = prior.volumes.slices.n_stacks > 1
    held_out = [_mean_held_out(registration)] if checked else []
    n_kept, n_moved = 0, list[int]()
    for number in range(n_rounds):
        progress(number, n_rounds)
        fitted = fit.run(prior, registration.weight, rng)
        moved, n_elsewhere = _registered_to_fit(registration, prior, fitted, fit.settings.newton_steps, rng)
        n_moved.append(n_elsewhere)
        if checked:
            held_out.append(_mean_held_out(moved))
            logger.info("poses, round %d: held-out correlation %.4f, before %.4f", number + 1, *held_out[:-3:-1])
            if held_out[-1] < max(held_out) - MAX_LOSS:
                prior = prior_of(registration, True)
                break
        registration, prior = moved, prior_of(moved, number == n_rounds - 1)
        n_kept += 1
    progress(n_rounds, n_rounds)
    held_out = [round(value, 4) for value in held_out]
    record = PoseRounds(n_kept=n_kept, held_out=held_out, n_moved=n_moved)
    return RefinedPoses(registration=registration, prior=prior, record=record)


def _mean_held_out(registration: Registration) -> float:
    return float(np.mean(fine_held_out_correlations(registration.slices, registration.gain)))


def _registered_to_fit(
    registration: Registration, prior: PriorVolume, fit: SliceFit, n_steps: int, rng: np.random.Generator
) -> tuple[Registration, int]:
    """Slices registered to the fitted volume from the poses of the fit, and how many of them changed place."""
    grid = prior.volumes.grid
    volume = volume_from_pixels(render(fit.cloud, volume_planes(grid)).numpy(), grid) * prior.support
    slices: Slices = prior.volumes.slices.with_pose(fit.slices.planes.pose)
    model = SampledSlices(slices, volume, grid, n_pixels=MAX_PIXELS)
    gain: NDArray[np.float64] = fit.gain
    width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
    at_start = model.evaluate(slices.planes, gain, width)
    weight = slice_weights(at_start.loss, gain, slices.n_stacks)
    # there is no volume of other stacks in which strays of a single stack could be found
    n_found = 0
    if slices.n_stacks > 1:
        slices, n_found = find_strays(slices, gain, weight, at_start.ncc, rng)
    slices, n_moved = try_neighbours(model, slices, gain, width=width)
    slices, gain, at_end = register_slices(model, slices, gain, n_steps=n_steps, width=width)
    moved = replace(
        registration,
        slices=without_excess_shear(registration.slices.with_pose(slices.planes.pose), registration.interleave),
        gain=gain,
        weight=slice_weights(at_end.loss, gain, slices.n_stacks),
        ncc=at_end.ncc,
    )
    return moved, n_moved + n_found
