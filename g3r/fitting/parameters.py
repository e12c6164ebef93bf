"""What the optimiser moves: the cloud's tensors, poses and gains, each with a step size of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from g3r.errors import NumericalError
from g3r.gaussians import GaussianCloud


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes: about the largest change of a parameter in one step.

    mean_share is relative to a Gaussian's own seed sigma and peak_share to the mean absolute peak, so that
    neither depends on the spacing of the seeds or the intensities. Turns are in rad, shifts in mm.
    """

    mean_share: float = 0.04
    log_scale: float = 0.02
    quaternion: float = 0.02
    peak_share: float = 0.04
    log_gain: float = 0.002
    shading: float = 0.008
    turn_rad: float = 1e-3
    shift_mm: float = 0.03


class CloudParameters:
    """A cloud under optimisation by Adam, with optional further parameter groups."""

    def __init__(
        self, cloud: GaussianCloud, rates: LearningRates, extra: list[tuple[Tensor, float]] | None = None
    ) -> None:
        self.origin_mm = cloud.origin_mm
        self.tensors = [p.detach().clone().float().requires_grad_() for p in cloud.parameters]
        sigma = float(cloud.log_scale.mean().exp()) if len(cloud) else 1.0
        height = float(cloud.peak.abs().mean()) if len(cloud) else 1.0
        steps = [rates.mean_share * sigma, rates.log_scale, rates.quaternion, rates.peak_share * height]
        groups = [*zip(self.tensors, steps, strict=True), *(extra or [])]
        self.base = [step for _, step in groups]
        self.optimiser = torch.optim.Adam(
            [{"params": [tensor], "lr": step} for tensor, step in groups], betas=(0.9, 0.99), fused=True
        )

    def cloud(self) -> GaussianCloud:
        """The present cloud, differentiable."""
        return GaussianCloud.of(self.tensors, self.origin_mm)

    def set_factor(self, factor: float) -> None:
        """Scale every step size."""
        for group, base in zip(self.optimiser.param_groups, self.base, strict=True):
            group["lr"] = base * factor

    def step(self, loss: Tensor) -> None:
        """One step down a loss.

        Raises:
            NumericalError: the loss is not finite.
        """
        if not math.isfinite(loss.item()):
            raise NumericalError(
                "the loss of the fit is not finite; lower the step sizes or check the intensities"
            )
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
