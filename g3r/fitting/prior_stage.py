"""Stage 1, the fit to the prior (G3R Eq. 8): Gaussians take the shape of the prior volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes, volume_planes
from g3r.fitting.divergence_guard import DivergenceGuard
from g3r.fitting.fit_context import FitContext
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.observer import FitMoment, is_due
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.plane_state import PlaneState
from g3r.fitting.schedules import cosine_decay
from g3r.gaussians import GaussianCloud, solve_amplitudes
from g3r.gaussians.amplitudes import MAX_PROJECTION_BYTES
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box
from g3r.run.deadline import timed_steps

PLANE_SHARE = 0.34
"""Share of the volume's planes in a step: a third of the work, and every plane is drawn several times in a fit."""

STEPS_PER_DRAW = 10
"""Steps between two draws of a volume's planes; each draw needs new overlap lists."""


@dataclass(frozen=True, kw_only=True)
class PriorStageSettings:
    """Settings of stage 1.

    Args:
        n_steps: optimiser steps after the amplitudes are solved for.
        amplitude_iterations: conjugate-gradient steps for the amplitudes.
        scale_weight: weight of the scale regulariser.
        cutoff_sigma: where a Gaussian ends.
        projection_bytes: see `solve_amplitudes`; less memory, more seconds, the same result.
    """

    n_steps: int = 30
    amplitude_iterations: int = 12
    scale_weight: float = 0.01
    cutoff_sigma: float = CUTOFF_SIGMA
    projection_bytes: int = MAX_PROJECTION_BYTES


@dataclass(frozen=True)
class PriorCloud:
    """The cloud that the fit to the prior gives, the loss of each step, and the spacing of the seeds."""

    cloud: GaussianCloud
    history: list[float]
    spacing_mm: float


@dataclass(frozen=True)
class VolumeTarget:
    """A volume as planes with pixels: the target of stage 1, and of the distillation in stage 2.

    Attributes:
        planes: [K] planes of the bounding box of positive weight.
        value: [P] the volume.
        weight: [P] not negative.
    """

    planes: Planes
    value: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def of(cls, volume: NDArray[np.float32], weight: NDArray[np.float32], grid: VolumeGrid) -> VolumeTarget:
        """Planes of a volume, cropped to where the weight is positive.

        Args:
            volume: [I, J, K].
            weight: [I, J, K].
            grid: of both.

        Raises:
            ValueError: the weight is zero everywhere.
        """
        inside = weight > 0
        if not inside.any():
            raise ValueError("the weight is zero everywhere")
        box = bounding_box(inside)

        def pixels(array: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.ascontiguousarray(array[box].transpose(2, 0, 1)).ravel().astype(np.float32)

        return cls(volume_planes(grid.cropped(box)), pixels(volume), pixels(weight))

    def take(self, index: NDArray[np.integer]) -> VolumeTarget:
        """Some of the planes with their pixels."""
        size = int(self.planes.offset[1])  # all planes of a volume are alike
        pixels = (index[:, None] * size + np.arange(size)).ravel()
        return VolumeTarget(self.planes.take(index), self.value[pixels], self.weight[pixels])


def fit_prior(
    cloud: GaussianCloud, target: VolumeTarget, settings: PriorStageSettings, context: FitContext
) -> tuple[GaussianCloud, list[float]]:
    """Fit a seeded cloud to the prior volume (G3R Eq. 8).

    First the amplitudes, by least squares on every second plane; then Adam on all parameters with the L1 loss on random
    planes and the scale regulariser. If the loss rises, the fit rolls back and takes shorter steps (`DivergenceGuard`).

    Args:
        cloud: seeded Gaussians.
        target: the prior volume.
        settings: numbers of steps, and weights.
        context: random numbers, progress, deadline and observer.

    Returns:
        The fitted cloud, and the image loss of each step.
    """
    every_second = target.take(np.arange(0, len(target.planes), 2))
    cloud = solve_amplitudes(
        cloud,
        every_second.planes,
        every_second.value,
        every_second.weight,
        n_iterations=settings.amplitude_iterations,
        cutoff_sigma=settings.cutoff_sigma,
        projection_bytes=settings.projection_bytes,
    )
    parameters = FitParameters(cloud, LearningRates())
    whole = ImageTerm.of(target.planes, target.value, target.weight, cutoff_sigma=settings.cutoff_sigma)
    objective = CloudObjective(parameters, settings.scale_weight)
    guard = DivergenceGuard(parameters, float(np.average(np.abs(target.value), weights=target.weight)))
    history = []
    n_planes = max(1, round(PLANE_SHARE * len(target.planes)))
    for step, fraction in timed_steps(settings.n_steps, context.deadline):
        context.progress(step, settings.n_steps)
        if step % STEPS_PER_DRAW == 0:
            term = whole.take(np.sort(context.rng.choice(len(target.planes), n_planes, replace=False)))
            terms = {"prior": (term, PlaneState.of(term.planes, cloud.origin_mm))}
        loss = objective.begin(terms)
        image = loss.add("prior", 1.0).mean
        guard.step(image + loss.finish(), cosine_decay(fraction))
        history.append(image)
        if is_due(observer := context.observer, step + 1, settings.n_steps):
            observer(FitMoment(step=step + 1, loss={"image": image}, parameters=parameters))
    context.progress(settings.n_steps, settings.n_steps)
    guard.finish()
    return parameters.cloud(), history
