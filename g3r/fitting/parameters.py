"""Parameters of the optimiser: the cloud's arrays, poses and gains in one buffer, each with a step size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.errors import NumericalError
from g3r.fitting import kernels
from g3r.gaussians import GaussianCloud
from g3r.run.on_demand import torch

BETA_1, BETA_2 = 0.9, 0.99
"""Decay of Adam's means of gradients and of their squares."""

CLOUD_BLOCKS = ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude")
"""Names of the cloud's own blocks, in the order of `GaussianCloud.parameters`."""

Block = tuple[NDArray[np.floating], float]
"""Start values and step size of a block of parameters."""

NOT_FINITE = "the loss of the fit is not finite; lower the step sizes or check the intensities"


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Adam step sizes: about the largest change of a parameter in one step.

    Attributes:
        mean_share: of the centres, over the mean sigma of the seeds, so that their spacing does not matter.
        log_scale: of the log-scales.
        quaternion: of the quaternions.
        amplitude_share: over the mean absolute amplitude, so that intensities do not matter.
        log_gain: of the slices' log-gains.
        bias_field: of the coefficients of the stacks' log-fields.
        rotation_rad: of the slices' rotation vectors.
        translation_mm: of the slices' translations.
        shear: of the open shear of two orientations (`fitting.open_shear`). Larger steps follow noise in still heads,
            where slices do not determine it.
    """

    mean_share: float = 0.04
    log_scale: float = 0.02
    quaternion: float = 0.02
    amplitude_share: float = 0.04
    log_gain: float = 0.016
    bias_field: float = 0.016
    rotation_rad: float = 2e-3
    translation_mm: float = 0.06
    shear: float = 5e-4


class FitParameters:
    """A cloud under optimisation by Adam, with further blocks of parameters where they are given.

    Values, gradients and Adam's two means are flat float32 buffers, taken once; `value` and `gradient` are
    views of them by name: mean_mm [N, 3], log_scale [N, 3], quaternion_wxyz [N, 4], amplitude [N], and the rest
    as given.

    Args:
        cloud: where the fit starts.
        rates: step sizes of the cloud.
        further: start values and step size of other blocks, by name.
    """

    def __init__(self, cloud: GaussianCloud, rates: LearningRates, further: Mapping[str, Block] | None = None) -> None:
        self.origin_mm = cloud.origin_mm
        sigma = float(cloud.log_scale.mean().exp()) if len(cloud) else 1.0
        height = float(cloud.amplitude.abs().mean()) if len(cloud) else 1.0
        steps = (rates.mean_share * sigma, rates.log_scale, rates.quaternion, rates.amplitude_share * height)
        start = {
            name: (tensor.detach().numpy(), step)
            for name, tensor, step in zip(CLOUD_BLOCKS, cloud.parameters, steps, strict=True)
        } | dict(further or {})
        n = sum(array.size for array, _ in start.values())
        self._buffers = np.zeros((4, n), np.float32)  # values, gradients, Adam's means
        self.value: dict[str, NDArray[np.float32]] = {}
        self.gradient: dict[str, NDArray[np.float32]] = {}
        self._blocks: list[tuple[slice, float]] = []
        end = 0
        for name, (array, step) in start.items():
            block = slice(end, end + array.size)
            end = block.stop
            self.value[name] = self._buffers[0, block].reshape(array.shape)
            self.gradient[name] = self._buffers[1, block].reshape(array.shape)
            self.value[name][...] = array
            self._blocks.append((block, step))
        self.n_steps = 0

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.value["amplitude"])

    @property
    def values(self) -> NDArray[np.float32]:
        """All values in one flat array (a view)."""
        return np.asarray(self._buffers[0])

    @property
    def gradients(self) -> NDArray[np.float32]:
        """All gradients in one flat array (a view)."""
        return np.asarray(self._buffers[1])

    def restart(self, values: NDArray[np.float32]) -> None:
        """Set other values, and begin Adam anew there."""
        self._buffers[0] = values
        self._buffers[2:] = 0.0
        self.n_steps = 0

    def cloud(self) -> GaussianCloud:
        """A copy of the present cloud.

        Raises:
            NumericalError: a value is outside the range that a cloud may have.
        """
        copies = [torch.from_numpy(self.value[name].copy()) for name in CLOUD_BLOCKS]
        try:
            return GaussianCloud.of(copies, self.origin_mm)
        except ValueError as error:
            raise NumericalError(f"the fit broke down ({error}); lower the step sizes") from None

    def step(self, loss: float, factor: float) -> None:
        """One step of Adam down the gradient, with all step sizes scaled by a factor.

        Args:
            loss: whose gradient it is.
            factor: of the step sizes.

        Raises:
            NumericalError: the loss is not finite (nothing is changed then), or a gradient is not.
        """
        if not math.isfinite(loss):
            raise NumericalError(NOT_FINITE)
        self.n_steps += 1
        correction, root = 1 - BETA_1**self.n_steps, math.sqrt(1 - BETA_2**self.n_steps)
        n_bad = 0
        for block, step in self._blocks:
            arrays = [buffer[block] for buffer in self._buffers]
            rate = kernels.AdamRate(step * factor, BETA_1, BETA_2, correction, root)
            n_bad += kernels.adam(*arrays, rate)  # type: ignore[call-arg]
        if n_bad:
            raise NumericalError(NOT_FINITE)
