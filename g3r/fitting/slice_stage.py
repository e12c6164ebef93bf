"""Stage 2 (G3R Eq. 9): Gaussians, poses and gains against the slices, the prior fading as a constraint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.bias_field import N_TERMS, StackBiasField
from g3r.fitting.divergence_guard import DivergenceGuard
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.observer import FitObserver
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.prior_stage import NO_PROGRESS, VolumeTarget
from g3r.fitting.schedules import AnnealedWeight, cosine_decay
from g3r.fitting.slice_term import SliceTerm
from g3r.gaussians import GaussianCloud, solve_amplitudes
from g3r.gaussians.amplitudes import MAX_PROJECTION_BYTES
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.run.deadline import Deadline, timed_steps

MAX_PRIOR_STRENGTH = 1.0
"""A pixel read off the prior never counts for more than a measured one."""


@dataclass(frozen=True)
class SliceStageSettings:
    """How stage 2 runs.

    Args:
        n_steps: optimiser steps.
        amplitude_iterations: conjugate-gradient steps for the amplitudes at the start; 0 leaves them as stage 1 did.
        amplitude_damping: pull of those towards the prior's amplitudes (relative).
        scale_weight: weight of the scale regulariser.
        distillation: w(i), weight of the distance to the prior, unless `prior_error` asks for more.
        prior_error: mean absolute error of the prior, in normalised intensities (0.054 from one, 0.043 from
            three stacks on the validation subjects of the shipped weights); see `prior_strength`. 0 leaves
            the strength to the schedule.
        distillation_planes: share of the prior's planes in a step (random).
        optimise_poses: whether slices move.
        pose_prior_mm: a slice that moves this far from where registration left it pays as much as a change of
            the mean residual by its own size would; keeps slices put that the data say nothing about.
        reweight_every: steps between two estimates of the trust in slices.
        steps_per_draw: steps between two draws of the prior's planes.
        optimise_bias_field: whether stacks have a smooth intensity field each (two stacks or more).
        bias_field_ridge: weight of the mean squared coefficient of the fields.
        attenuation: "exact", or "printed" for comparison.
        cutoff_sigma: where a Gaussian ends, here and in the volume; smaller is faster and less exact.
        projection_bytes: see `solve_amplitudes`; less memory, more seconds, the same result.
        rates: step sizes.
    """

    n_steps: int = 100
    amplitude_iterations: int = 6
    amplitude_damping: float = 0.05
    scale_weight: float = 0.02
    distillation: AnnealedWeight = field(default_factory=lambda: AnnealedWeight(0.2, 0.02))
    prior_error: float = 0.05
    distillation_planes: float = 0.1
    optimise_poses: bool = True
    pose_prior_mm: float = 10.0
    reweight_every: int = 20
    steps_per_draw: int = 10
    optimise_bias_field: bool = True
    bias_field_ridge: float = 0.005
    attenuation: str = "exact"
    cutoff_sigma: float = CUTOFF_SIGMA
    projection_bytes: int = MAX_PROJECTION_BYTES
    rates: LearningRates = field(default_factory=LearningRates)


@dataclass(frozen=True)
class SliceFit:
    """Result of stage 2.

    cloud; slices in their last poses; gain [K], weight [K]; loss of each step, marked `rollback` where the
    loss had risen and the step was back to the best state (`DivergenceGuard`); coefficients of each stack's shading
    (see `StackBiasField`; empty where it was not estimated).
    """

    cloud: GaussianCloud
    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    history: list[dict[str, float]]
    bias_field: list[list[float]]


def fit_slices(
    cloud: GaussianCloud,
    slices: Slices,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    prior: VolumeTarget | None,
    settings: SliceStageSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] = NO_PROGRESS,
    deadline: Deadline | None = None,
    observer: FitObserver | None = None,
) -> SliceFit:
    """Refine a cloud against slices.

    Args:
        cloud: from stage 1.
        slices: intensities of order one, poses from registration.
        gain: [K] intensity factor of each slice, from registration.
        weight: [K] trust in each slice, from registration.
        prior: what to stay near to, with a weight from 0 (measured) to 1 (not measured) for each voxel; None
            leaves the term out.
        settings: how long and how hard.
        rng: draws the prior's planes.
        progress: called with (steps done, steps in all).
        deadline: fewer steps if they would end after it; schedules run to their ends even so.
        observer: sees the cloud as the fit goes on; None for nobody.

    Raises:
        NumericalError: a loss that is not finite from the start.
    """
    slice_weight = weight.astype(np.float32)
    if settings.amplitude_iterations:
        cloud = solve_amplitudes(
            cloud,
            slices.planes,
            slices.value,
            slices.mask * slice_weight[slices.planes.plane_id()],
            gain=gain,
            n_iterations=settings.amplitude_iterations,
            damping=settings.amplitude_damping,
            attenuation=settings.attenuation,
            cutoff_sigma=settings.cutoff_sigma,
            projection_bytes=settings.projection_bytes,
        )
    several = slices.n_stacks > 1  # one stack cannot tell its shading from anatomy
    bias_field = StackBiasField(slices) if settings.optimise_bias_field and several else None
    parameters = FitParameters(cloud, settings.rates, _blocks(slices, gain, bias_field, settings))
    loss = SliceLoss(parameters, slices, gain, slice_weight.astype(np.float64), bias_field, prior, settings)
    guard = DivergenceGuard(parameters, loss.level)
    history: list[dict[str, float]] = []
    for step, fraction in timed_steps(settings.n_steps, deadline):
        progress(step, settings.n_steps)
        if step % settings.steps_per_draw == 0:
            loss.draw(rng)
        value, entry = loss.evaluate(fraction)
        if not guard.step(value, cosine_decay(fraction)):
            entry |= {"rollback": 1.0}
        history.append(entry)
        if step and step % settings.reweight_every == 0:
            guard.rescale(loss.reweight())
        if observer and ((step + 1) % observer.every == 0 or step + 1 == settings.n_steps):
            loss.term.update()
            observer(step + 1, parameters.cloud(), loss.term.moved_planes().pose)
    progress(settings.n_steps, settings.n_steps)
    guard.finish()
    term = loss.term
    term.update()
    return SliceFit(
        parameters.cloud(),
        slices.with_pose(term.moved_planes().pose),
        term.gain,
        term.slice_weight,
        history,
        parameters.value["shading"].astype(float).tolist() if bias_field else [],
    )


class SliceLoss:
    """The loss of stage 2 with all its terms; its gradient is written into the parameters.

    L = L1(slices) + lambda R_scale + w(i) L1(prior), and the terms that hold poses and fields (`SliceTerm`).

    Args:
        parameters: with the blocks that are fitted along.
        slices: K slices.
        gain: [K] where no block holds it.
        slice_weight: [K] in each slice.
        bias_field: fields of the stacks, or None.
        prior: distillation target, or None.
        settings: weights of the terms.
    """

    def __init__(
        self,
        parameters: FitParameters,
        slices: Slices,
        gain: NDArray[np.float64],
        slice_weight: NDArray[np.float64],
        bias_field: StackBiasField | None,
        prior: VolumeTarget | None,
        settings: SliceStageSettings,
    ) -> None:
        self.settings = settings
        self.term = SliceTerm(
            slices, gain, slice_weight, parameters, bias_field, settings.attenuation == "exact", settings.cutoff_sigma
        )
        self.level = float(np.abs(slices.masked_value).mean()) if len(slices.masked_value) else 0.0
        self.distilled: ImageTerm | None = None
        terms: list[ImageTerm] = [self.term]
        if prior is not None:
            self.distilled = ImageTerm(
                prior.planes, prior.value, prior.weight, parameters.origin_mm, cutoff_sigma=settings.cutoff_sigma
            )
            # the distance is a mean over the prior's trust, so this makes the term the mean over the head of
            # trust times difference: well-measured heads feel little of it, sparsely measured ones much
            self.prior_share = float(prior.weight[prior.weight > 0].mean())
            terms.append(self.distilled)
        self.objective = CloudObjective(parameters, terms, settings.scale_weight)

    def draw(self, rng: np.random.Generator) -> None:
        """Let other planes of the prior count, at random."""
        if self.distilled is not None:
            n = len(self.distilled.every)
            n_planes = max(1, round(self.settings.distillation_planes * n))
            self.distilled.choose(np.sort(rng.choice(n, n_planes, replace=False)))

    def evaluate(self, fraction: float) -> tuple[float, dict[str, float]]:
        """The loss at the present parameters and a fraction of the fit, and its terms by name."""
        settings = self.settings
        self.term.update()
        self.objective.begin()
        image = self.objective.add(self.term, 1.0)
        loss, entry = image, {"image": image}
        strength = prior_strength(settings, fraction, image)
        if self.distilled is not None and strength > 0:
            distance = self.objective.add(self.distilled, strength * self.prior_share)
            loss += strength * self.prior_share * distance
            entry |= {"distillation": distance, "distillation_weight": strength}
        loss += self.objective.finish()
        loss += self.term.finish(image, settings.pose_prior_mm, settings.bias_field_ridge)
        return loss, entry

    def reweight(self) -> float:
        """Trust the slices by how they fitted last; returns what the image term is, over what it was."""
        before = self.term.mean_residual
        self.term.reweight()
        return self.term.mean_residual / before if before > 0 else 1.0


def _blocks(
    slices: Slices, gain: NDArray[np.float64], bias_field: StackBiasField | None, settings: SliceStageSettings
) -> dict[str, tuple[NDArray[np.floating], float]]:
    """What is fitted along with the cloud: start values and step sizes."""
    n, rates = len(slices), settings.rates
    blocks: dict[str, tuple[NDArray[np.floating], float]] = {}
    if settings.optimise_poses:
        blocks |= {"turn": (np.zeros((n, 3)), rates.rotation_rad), "shift": (np.zeros((n, 3)), rates.translation_mm)}
    if n > 1:  # the gain of a single slice cannot be told from the amplitudes
        blocks["log_gain"] = (np.log(gain), rates.log_gain)
    if bias_field:
        blocks["shading"] = (np.zeros((len(bias_field.stacks), N_TERMS)), rates.bias_field)
    return blocks


def prior_strength(settings: SliceStageSettings, fraction: float, residual: float) -> float:
    """w(i): annealed as in G3R, but not below what the slices' residual and the prior's error ask for.

    A voxel with confidence c counts as if 1 - c missing pixels had been read off the prior. Under L1 (Laplace
    distributions) a pixel weighs one over its mean absolute error, so one read off the prior weighs
    residual / prior_error times one that was measured: little where slices fit much better than the prior is
    known to, much where noise or motion spoil them.

    Args:
        settings: the schedule, and the prior's error.
        fraction: of the fit that is done.
        residual: mean absolute residual of the slices at present.
    """
    annealed = settings.distillation.at(fraction)
    if settings.prior_error <= 0 or not settings.distillation.start > 0:
        return annealed
    return max(annealed, min(residual / settings.prior_error, MAX_PRIOR_STRENGTH))
