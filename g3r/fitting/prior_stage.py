"""Stage 1 (G3R Eq. 8): the Gaussians take the shape of the prior volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes, volume_planes
from g3r.fitting.divergence_guard import DivergenceGuard
from g3r.fitting.objective import CloudObjective, ImageTerm
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.schedules import cosine_decay
from g3r.gaussians import GaussianCloud, solve_amplitudes
from g3r.gaussians.amplitudes import MAX_PROJECTION_BYTES
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.geometry import VolumeGrid
from g3r.run.deadline import Deadline, timed_steps

NO_PROGRESS: Callable[[int, int], None] = lambda done, total: None  # noqa: E731


@dataclass(frozen=True)
class PriorStageSettings:
    """How stage 1 runs.

    Args:
        n_steps: optimiser steps after the amplitudes are solved for.
        amplitude_iterations: conjugate-gradient steps for the amplitudes.
        plane_share: share of the volume's planes in a step.
        scale_weight: weight of the scale regulariser.
        steps_per_draw: steps between two draws of the planes.
        cutoff_sigma: where a Gaussian ends.
        projection_bytes: see `solve_amplitudes`; less memory, more seconds, the same result.
    """

    n_steps: int = 30
    amplitude_iterations: int = 12
    plane_share: float = 0.34
    scale_weight: float = 0.01
    steps_per_draw: int = 10
    cutoff_sigma: float = CUTOFF_SIGMA
    projection_bytes: int = MAX_PROJECTION_BYTES


@dataclass(frozen=True)
class PriorCloud:
    """The cloud that the fit to the prior gives, the loss of each step, and how its Gaussians came about."""

    cloud: GaussianCloud
    history: list[float]
    counts: dict[str, Any]


@dataclass(frozen=True)
class VolumeTarget:
    """A volume as planes with pixels: what stage 1 fits and what stage 2 is distilled towards.

    planes [K] cover the bounding box of the mask; value [P] and weight [P] are the volume and its trust.
    """

    planes: Planes
    value: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def of(cls, volume: NDArray[np.float32], weight: NDArray[np.float32], grid: VolumeGrid) -> VolumeTarget:
        """Planes of a volume [I, J, K], cropped to where the weight [I, J, K] is positive.

        Raises:
            ValueError: the weight is zero everywhere.
        """
        inside = np.argwhere(weight > 0)
        if not len(inside):
            raise ValueError("the weight is zero everywhere")
        low, high = inside.min(0), inside.max(0) + 1
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        affine = grid.affine.copy()
        affine[:3, 3] = grid.world(low)
        cropped = VolumeGrid(tuple(high - low), affine)

        def pixels(array: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.ascontiguousarray(array[box].transpose(2, 0, 1)).ravel().astype(np.float32)

        return cls(volume_planes(cropped), pixels(volume), pixels(weight))

    def take(self, index: NDArray[np.integer]) -> VolumeTarget:
        """Some of the planes with their pixels."""
        size = int(self.planes.offset[1])  # all planes of a volume are alike
        pixels = (index[:, None] * size + np.arange(size)).ravel()
        return VolumeTarget(self.planes.take(index), self.value[pixels], self.weight[pixels])


def fit_prior(
    cloud: GaussianCloud,
    target: VolumeTarget,
    settings: PriorStageSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] = NO_PROGRESS,
    deadline: Deadline | None = None,
) -> tuple[GaussianCloud, list[float]]:
    """Fit a seeded cloud to the prior volume.

    Amplitudes first, by least squares on every second plane; then Adam on everything with the L1 loss on random
    planes and the scale regulariser; fewer steps if they would end after the deadline. A loss that rises is
    answered by going back to the best state with shorter steps (`DivergenceGuard`).

    Returns:
        The fitted cloud, and the image loss of each step.
    """
    every_second = target.take(np.arange(0, len(target.planes), 2))
    cloud = solve_amplitudes_on(
        cloud, every_second, settings.amplitude_iterations, settings.cutoff_sigma, settings.projection_bytes
    )
    parameters = FitParameters(cloud, LearningRates())
    term = ImageTerm(target.planes, target.value, target.weight, cloud.origin_mm, cutoff_sigma=settings.cutoff_sigma)
    objective = CloudObjective(parameters, [term], settings.scale_weight)
    guard = DivergenceGuard(parameters, float(np.average(np.abs(target.value), weights=target.weight)))
    history = []
    n_planes = max(1, round(settings.plane_share * len(target.planes)))
    for step, fraction in timed_steps(settings.n_steps, deadline):
        progress(step, settings.n_steps)
        if step % settings.steps_per_draw == 0:
            term.choose(np.sort(rng.choice(len(target.planes), n_planes, replace=False)))
        objective.begin()
        image = objective.add(term, 1.0)
        guard.step(image + objective.finish(), cosine_decay(fraction))
        history.append(image)
    progress(settings.n_steps, settings.n_steps)
    guard.finish()
    return parameters.cloud(), history


def solve_amplitudes_on(
    cloud: GaussianCloud,
    target: VolumeTarget,
    n_iterations: int,
    cutoff_sigma: float = CUTOFF_SIGMA,
    projection_bytes: int = MAX_PROJECTION_BYTES,
) -> GaussianCloud:
    """Amplitudes of a cloud by least squares on the planes of a volume."""
    return solve_amplitudes(
        cloud,
        target.planes,
        target.value,
        target.weight,
        n_iterations=n_iterations,
        cutoff_sigma=cutoff_sigma,
        projection_bytes=projection_bytes,
    )
