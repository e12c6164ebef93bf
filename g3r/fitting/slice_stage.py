"""Stage 2 (G3R Eq. 9): Gaussians, poses and gains against the slices, the prior fading as a constraint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.losses import scale_regulariser, weighted_l1
from g3r.fitting.observer import FitObserver
from g3r.fitting.parameters import CloudParameters, LearningRates
from g3r.fitting.prior_stage import NO_PROGRESS, PAIR_MARGIN_SIGMA, VolumeTarget
from g3r.fitting.schedules import AnnealedWeight, cosine_decay
from g3r.fitting.shading import N_TERMS, StackShading
from g3r.gaussians import GaussianCloud, find_pairs, render, solve_peaks
from g3r.gaussians.render import CUTOFF_SIGMA, moved_planes
from g3r.motion.slice_rounds import slice_weights

MOST_PRIOR_STRENGTH = 1.0
"""A pixel read off the prior never counts for more than a measured one."""


@dataclass(frozen=True)
class SliceStageSettings:
    """How stage 2 runs.

    Args:
        n_steps: optimiser steps.
        peak_iterations: conjugate-gradient steps for the peaks at the start; 0 leaves them as stage 1 did.
        peak_damping: pull of those towards the prior's peaks (relative).
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
        steps_per_pair_list: steps between two searches for pairs.
        optimise_shading: whether stacks have a smooth intensity field each (two stacks or more).
        shading_ridge: weight of the mean squared coefficient of the fields.
        amplitude: "exact", or "printed" for comparison.
        cutoff_sigma: where a Gaussian ends, here and in the volume; smaller is faster and less exact.
        rates: step sizes.
    """

    n_steps: int = 100
    peak_iterations: int = 6
    peak_damping: float = 0.05
    scale_weight: float = 0.02
    distillation: AnnealedWeight = field(default_factory=lambda: AnnealedWeight(0.2, 0.02))
    prior_error: float = 0.05
    distillation_planes: float = 0.1
    optimise_poses: bool = True
    pose_prior_mm: float = 10.0
    reweight_every: int = 20
    steps_per_pair_list: int = 10
    optimise_shading: bool = True
    shading_ridge: float = 0.005
    amplitude: str = "exact"
    cutoff_sigma: float = CUTOFF_SIGMA
    rates: LearningRates = field(default_factory=LearningRates)


@dataclass(frozen=True)
class SliceFit:
    """Result of stage 2.

    cloud; slices in their last poses; gain [K], weight [K]; loss of each step; coefficients of each stack's
    shading (see `StackShading`; empty where it was not estimated).
    """

    cloud: GaussianCloud
    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    history: list[dict[str, float]]
    shading: list[list[float]]


def fit_slices(
    cloud: GaussianCloud,
    slices: Slices,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    prior: VolumeTarget | None,
    settings: SliceStageSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] = NO_PROGRESS,
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
        observer: sees the cloud as the fit goes on; None for nobody.

    Raises:
        NumericalError: a loss that is not finite.
    """
    planes = slices.planes
    target = torch.from_numpy(slices.value)
    inside = torch.from_numpy(slices.mask.astype(np.float32))
    plane_of_pixel = torch.from_numpy(planes.plane_id())
    trust = torch.from_numpy(weight.astype(np.float32))
    pixel_weight = inside * trust[plane_of_pixel]
    n_slices = len(slices)
    if settings.peak_iterations:
        cloud = solve_peaks(
            cloud, planes, slices.value, pixel_weight.numpy(), gain=gain,
            n_iterations=settings.peak_iterations, damping=settings.peak_damping,
            amplitude=settings.amplitude, cutoff_sigma=settings.cutoff_sigma,
        )  # fmt: skip
    turn, shift = torch.zeros(n_slices, 3), torch.zeros(n_slices, 3)
    log_gain = torch.from_numpy(np.log(gain).astype(np.float32))
    free_gain = n_slices > 1  # the gain of a single slice cannot be told from the peaks
    extra = []
    if settings.optimise_poses:
        extra += [
            (turn.requires_grad_(), settings.rates.turn_rad),
            (shift.requires_grad_(), settings.rates.shift_mm),
        ]
    if free_gain:
        extra += [(log_gain.requires_grad_(), settings.rates.log_gain)]
    # one stack cannot tell its shading from anatomy
    shading = (
        StackShading(slices) if settings.optimise_shading and len(np.unique(slices.stack_id)) > 1 else None
    )
    coefficients = torch.zeros(len(np.unique(slices.stack_id)), N_TERMS)
    if shading:
        extra.append((coefficients.requires_grad_(), settings.rates.shading))
    parameters = CloudParameters(cloud, settings.rates, extra)
    seed_log_scale = cloud.log_scale.detach().clone()
    radius_mm = float(np.sqrt(((planes.shape * planes.spacing_mm / 2) ** 2).sum(1)).mean()) / 2
    # with the distance being a mean over the prior's trust, this makes the term the mean over the head of
    # trust times difference: well-measured heads feel little of it, sparsely measured ones much
    prior_share = float(prior.weight[prior.weight > 0].mean()) if prior is not None else 0.0
    history: list[dict[str, float]] = []
    reach_sigma = settings.cutoff_sigma + PAIR_MARGIN_SIGMA
    for step in range(settings.n_steps):
        fraction = step / settings.n_steps
        progress(step, settings.n_steps)
        twist = torch.cat([turn, shift], 1) if settings.optimise_poses else None
        current = parameters.cloud()
        if step % settings.steps_per_pair_list == 0:
            pairs = find_pairs(current.detach(), moved_planes(planes, twist), reach_sigma)
            if prior is not None:
                n_planes = max(1, round(settings.distillation_planes * len(prior.planes)))
                part = prior.take(np.sort(rng.choice(len(prior.planes), n_planes, replace=False)))
                part_pairs = find_pairs(current.detach(), part.planes, reach_sigma)
                part_value, part_weight = torch.from_numpy(part.value), torch.from_numpy(part.weight)
        parameters.set_factor(cosine_decay(fraction))
        centred = log_gain - log_gain.mean() if free_gain else log_gain
        pixels = render(
            current, planes, twist=twist, log_gain=centred, pairs=pairs, amplitude=settings.amplitude,
            cutoff_sigma=settings.cutoff_sigma,
        )  # fmt: skip
        if shading:
            pixels = pixels * shading.log_field(coefficients).exp()
        image = weighted_l1(pixels, target, pixel_weight)
        loss = image + settings.scale_weight * scale_regulariser(current.log_scale, seed_log_scale)
        entry = {"image": image.item()}
        if shading:
            loss = loss + settings.shading_ridge * coefficients.square().mean()
        strength = prior_strength(settings, fraction, entry["image"])
        if prior is not None and strength > 0:
            seen = render(current, part.planes, pairs=part_pairs, cutoff_sigma=settings.cutoff_sigma)
            distance = weighted_l1(seen, part_value, part_weight)
            loss = loss + strength * prior_share * distance
            entry |= {"distillation": distance.item(), "distillation_weight": strength}
        if settings.optimise_poses:
            moved_mm2 = (shift.square().sum(1) + (radius_mm * turn).square().sum(1)).mean()
            loss = loss + image.item() * moved_mm2 / settings.pose_prior_mm**2
        parameters.step(loss)
        history.append(entry)
        if step and step % settings.reweight_every == 0:
            trust = torch.from_numpy(_trust(pixels.detach(), target, inside, plane_of_pixel, n_slices))
            pixel_weight = inside * trust[plane_of_pixel]
        if observer and ((step + 1) % observer.every == 0 or step + 1 == settings.n_steps):
            moved = moved_planes(planes, torch.cat([turn, shift], 1) if settings.optimise_poses else None)
            observer(step + 1, parameters.cloud().detach(), moved.pose)
    progress(settings.n_steps, settings.n_steps)
    final_gain = torch.exp(log_gain - log_gain.mean() if free_gain else log_gain).detach().double().numpy()
    moved = planes
    if settings.optimise_poses:
        moved = moved_planes(planes, torch.cat([turn, shift], 1))
    return SliceFit(
        parameters.cloud().detach(),
        slices.with_pose(moved.pose),
        final_gain,
        trust.double().numpy(),
        history,
        coefficients.detach().double().tolist() if shading else [],
    )


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
    return max(annealed, min(residual / settings.prior_error, MOST_PRIOR_STRENGTH))


def _trust(
    pixels: torch.Tensor, target: torch.Tensor, inside: torch.Tensor, plane: torch.Tensor, n_slices: int
) -> NDArray[np.float32]:
    """Trust in each slice [K] from its mean absolute residual."""
    total = torch.zeros(n_slices).index_add_(0, plane, inside * (pixels - target).abs())
    count = torch.zeros(n_slices).index_add_(0, plane, inside)
    return slice_weights((total / count.clamp_min(1)).double().numpy()).astype(np.float32)
