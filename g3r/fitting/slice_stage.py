"""Stage 2, the fit to the slices (G3R Eq. 9): Gaussians, poses and gains, with the prior as a fading constraint."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import slice_weights
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.divergence_guard import DivergenceGuard
from g3r.fitting.fit_context import FitContext
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.observer import FitMoment, SliceMoment, is_due
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.plane_state import PlaneState
from g3r.fitting.prior_stage import STEPS_PER_DRAW, VolumeTarget
from g3r.fitting.schedules import AnnealedWeight, cosine_decay, prior_strength
from g3r.fitting.slice_parameters import SliceParameters, slice_blocks
from g3r.fitting.slice_turns import SliceTurns
from g3r.gaussians import GaussianCloud, solve_amplitudes
from g3r.gaussians.amplitudes import MAX_PROJECTION_BYTES
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.run.deadline import timed_steps

AMPLITUDE_DAMPING = 0.05
"""Pull of the first amplitudes towards stage 1 (relative): slices do not determine Gaussians that lie between them."""


@dataclass(frozen=True, kw_only=True)
class SliceStageSettings:
    """Settings of stage 2.

    Args:
        n_steps: optimiser steps.
        n_parts: steps in which every slice is seen once; two steps on half of the slices do more than one on all.
        amplitude_iterations: conjugate-gradient steps for the amplitudes at the start; 0 keeps those of stage 1.
        scale_weight: weight of the scale regulariser.
        distillation: w(i), weight of the distance to the prior, unless `prior_error` requires more.
        prior_error: mean absolute error of the prior, in normalised intensities (0.054 from one, 0.043 from three
            stacks on the validation subjects of the shipped weights); see `prior_strength`. With 0 the schedule
            alone decides.
        distillation_planes: share of the prior's planes in a step (random).
        optimise_poses: whether slices move.
        pose_prior_mm: movement from the registered pose at which the pose prior of a slice equals the mean residual;
            holds slices that the data do not determine.
        reweight_every: steps between two estimates of the slice weights.
        optimise_bias_field: whether stacks have a smooth intensity field each (two stacks or more).
        bias_field_ridge: weight of the mean squared coefficient of the fields.
        cutoff_sigma: where a Gaussian ends, here and in the volume; smaller is faster and less exact.
        projection_bytes: see `solve_amplitudes`; less memory, more seconds, the same result.
        rates: step sizes.
    """

    n_steps: int = 130
    n_parts: int = 2
    amplitude_iterations: int = 6
    scale_weight: float = 0.02
    distillation: AnnealedWeight = field(default_factory=lambda: AnnealedWeight(0.2, 0.02))
    prior_error: float = 0.05
    distillation_planes: float = 0.05
    optimise_poses: bool = True
    pose_prior_mm: float = 10.0
    reweight_every: int = 20
    optimise_bias_field: bool = True
    bias_field_ridge: float = 0.02
    cutoff_sigma: float = CUTOFF_SIGMA
    projection_bytes: int = MAX_PROJECTION_BYTES
    rates: LearningRates = field(default_factory=LearningRates)


@dataclass(frozen=True, kw_only=True)
class SliceFit:
    """Result of stage 2.

    Attributes:
        cloud: the Gaussians.
        slices: in their last poses.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        history: terms of the loss of each step, with `rollback` where the divergence guard rolled back.
        bias_field: [n_stacks][5] coefficients (see `StackBiasField`); empty where it was not estimated.
        further: clouds of fits on other lattices, whose mean with `cloud` is the volume (`fitting.lattice_mean`).
    """

    cloud: GaussianCloud
    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    history: list[dict[str, float]]
    bias_field: list[list[float]]
    further: tuple[GaussianCloud, ...] = ()

    @property
    def n_rollbacks(self) -> int:
        """Times that the divergence guard rolled back."""
        return sum("rollback" in entry for entry in self.history)


def fit_slices(
    cloud: GaussianCloud,
    slices: Slices,
    *,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    prior: VolumeTarget | None,
    settings: SliceStageSettings,
    context: FitContext,
    pixel_weight: NDArray[np.float32] | None = None,
) -> SliceFit:
    """Refine a cloud against slices (G3R Eq. 9).

    Args:
        cloud: from stage 1.
        slices: K slices, intensities of order one, poses from registration.
        gain: [K] intensity factor of each slice, from registration.
        weight: [K] slice weights, from registration.
        prior: target of the distillation, with a weight from 0 (measured) to 1 (not measured) for each voxel; None
            without distillation.
        settings: numbers of steps, and weights.
        context: random numbers, progress, deadline and observer.
        pixel_weight: [P] not negative; the slices' masks when None.

    Raises:
        NumericalError: a loss that is not finite from the start.
    """
    slice_weight = weight.astype(np.float32)
    counted = slices.mask.astype(np.float32) if pixel_weight is None else pixel_weight
    if settings.amplitude_iterations:
        cloud = solve_amplitudes(
            cloud,
            slices.planes,
            slices.value,
            counted * slice_weight[slices.planes.plane_id()],
            gain=gain,
            n_iterations=settings.amplitude_iterations,
            damping=AMPLITUDE_DAMPING,
            cutoff_sigma=settings.cutoff_sigma,
            projection_bytes=settings.projection_bytes,
        )
    several = slices.n_stacks > 1  # one stack cannot separate its bias field from anatomy
    bias_field = StackBiasField(slices) if settings.optimise_bias_field and several else None
    blocks = slice_blocks(slices, gain, bias_field, settings.rates, settings.optimise_poses)
    parameters = FitParameters(cloud, settings.rates, blocks)
    loss = SliceLoss(
        parameters,
        slices,
        gain=gain,
        slice_weight=slice_weight.astype(np.float64),
        bias_field=bias_field,
        prior=prior,
        settings=settings,
        pixel_weight=counted,
    )
    guard = DivergenceGuard(parameters, loss.level)
    history: list[dict[str, float]] = []
    for step, fraction in timed_steps(settings.n_steps, context.deadline):
        context.progress(step, settings.n_steps)
        if step % STEPS_PER_DRAW == 0:
            loss.draw(context.rng)
        value, entry = loss.evaluate(fraction)
        if not guard.step(value, cosine_decay(fraction)):
            entry |= {"rollback": 1.0}
            loss.turns.forget()
        loss.unknowns.fold()
        history.append(entry)
        if step and step % settings.reweight_every == 0:
            guard.rescale(loss.reweight())
        if is_due(observer := context.observer, step + 1, settings.n_steps):
            moved = SliceMoment(loss.state(), slices)
            observer(FitMoment(step=step + 1, loss=entry, parameters=parameters, slices=moved))
    context.progress(settings.n_steps, settings.n_steps)
    guard.finish()
    state = loss.state()
    return SliceFit(
        cloud=parameters.cloud(),
        slices=slices.with_pose(state.pose(cloud.origin_mm)),
        gain=state.gain,
        weight=state.slice_weight,
        history=history,
        bias_field=parameters.value["bias_field"].astype(float).tolist() if bias_field else [],
    )


class SliceLoss:
    """The loss of stage 2 with all its terms (G3R Eq. 9); its gradient is written into the parameters.

    L = L1(slices) + lambda R_scale + w(i) L1(prior), and the terms of poses and fields alone (`SliceParameters`).

    Args:
        parameters: with the blocks that are fitted along.
        slices: K slices.
        gain: [K] where no block holds it.
        slice_weight: [K].
        bias_field: fields of the stacks, or None.
        prior: distillation target, or None.
        settings: weights of the terms.
        pixel_weight: [P] not negative; the slices' masks when None.
    """

    def __init__(
        self,
        parameters: FitParameters,
        slices: Slices,
        *,
        gain: NDArray[np.float64],
        slice_weight: NDArray[np.float64],
        bias_field: StackBiasField | None,
        prior: VolumeTarget | None,
        settings: SliceStageSettings,
        pixel_weight: NDArray[np.float32] | None = None,
    ) -> None:
        self.settings, self.slice_weight, self.n_stacks = settings, slice_weight, slices.n_stacks
        self.origin_mm = parameters.origin_mm
        self.unknowns = SliceParameters(slices, gain, parameters)
        self.term = ImageTerm.of(
            slices.planes,
            slices.value,
            slices.mask.astype(np.float32) if pixel_weight is None else pixel_weight,
            basis=bias_field.basis if bias_field else None,
            with_pose=self.unknowns.with_pose,
            cutoff_sigma=settings.cutoff_sigma,
        )
        self.turns = SliceTurns(self.term, slices.stack_id, settings.n_parts)
        self.level = float(np.abs(slices.masked_value).mean()) if len(slices.masked_value) else 0.0
        self.objective = CloudObjective(parameters, settings.scale_weight)
        self.prior: ImageTerm | None = None
        if prior is not None:
            self.prior = ImageTerm.of(prior.planes, prior.value, prior.weight, cutoff_sigma=settings.cutoff_sigma)
            # the distance is a weighted mean, so this factor makes the term the mean over the head of weight times
            # difference: it is small in well-measured heads and large in sparsely measured ones
            self.prior_share = float(prior.weight[prior.weight > 0].mean())
            self._distil(self.prior)

    def _distil(self, term: ImageTerm) -> None:
        self.distilled, self.distilled_state = term, PlaneState.of(term.planes, self.origin_mm)

    def draw(self, rng: np.random.Generator) -> None:
        """Draw other planes of the prior at random."""
        if self.prior is not None:
            n = len(self.prior.planes)
            n_planes = max(1, round(self.settings.distillation_planes * n))
            self._distil(self.prior.take(np.sort(rng.choice(n, n_planes, replace=False))))

    def state(self) -> PlaneState:
        """The slices at the present parameters."""
        return self.unknowns.state(self.slice_weight)

    def evaluate(self, fraction: float) -> tuple[float, dict[str, float]]:
        """The loss at the present parameters and a fraction of the fit, and its terms by name.

        The gradient is that of the slices whose turn it is; the loss is that of all slices (`SliceTurns`).
        """
        settings, terms = self.settings, {"slices": (self.term, self.state())}
        if self.prior is not None:
            terms["prior"] = self.distilled, self.distilled_state
        step = self.objective.begin(terms)
        slices = step.add("slices", 1.0, self.turns.next())
        self.turns.put(slices)
        image = self.turns.mean(self.slice_weight)
        loss, entry = image, {"image": image}
        strength = prior_strength(settings.distillation, settings.prior_error, fraction, image)
        if self.prior is not None and strength > 0:
            distance = step.add("prior", strength * self.prior_share).mean
            loss += strength * self.prior_share * distance
            entry |= {"distillation": distance, "distillation_weight": strength}
        loss += step.finish()
        loss += self.unknowns.finish(slices, settings.pose_prior_mm, settings.bias_field_ridge)
        return loss, entry

    def reweight(self) -> float:
        """Compute slice weights from the last residual of every slice; returns the new image term over the old."""
        if not self.turns.is_complete:  # after a rollback
            return 1.0
        residual = self.turns.residual
        before = self.term.mean(residual, self.slice_weight)
        typical = residual / np.maximum(self.term.total_weight, 1)
        weight = slice_weights(typical, self.state().gain, self.n_stacks)
        self.slice_weight = weight.astype(np.float32).astype(np.float64)
        return self.term.mean(residual, self.slice_weight) / before if before > 0 else 1.0
