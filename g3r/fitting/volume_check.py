"""Check that a volume, before its correction on voxels, explains the slices as well as those that it was made from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.best_gains import best_gains
from g3r.fitting.bias_field import StackBiasField
from g3r.geometry import VolumeGrid

INSIDE = 0.99
"""Share of a pixel in the brain from which on the pixel counts."""
MAX_PIXELS = 100_000
"""Largest number of pixels in use; more change a residual by less than 0.0005."""
EQUAL = 0.03
"""Two residuals are equal if the smaller is less than the larger by no more than this share of it. V_prior shows more
of the slices' noise, which also explains them: at an SNR of 4 to 6 its residual was smaller by up to 0.015 of the
volume's on heads on which the volume was nearer to the truth by 0.7 to -0.3 dB (seven heads, by hand)."""
N_ROUNDS = 2
"""Rounds in which gains of slices and fields of stacks are found in turn; a third does not change the third digit."""


@dataclass(frozen=True, kw_only=True)
class VolumeCheck:
    """How well volumes explain the slices of a subject.

    Attributes:
        volume, prior, coarse: root mean square error of the masked pixels that the mixture, V_prior and V_coarse
            predict, each with gains and bias fields of its own, as a share of the root mean square of the
            pixels.
    """

    volume: float
    prior: float
    coarse: float

    @property
    def falls_back(self) -> bool:
        """Whether V_prior is to be written in place of the mixture."""
        return self.prior < (1 - EQUAL) * self.volume

    def line(self) -> str:
        """The line for a user if the fit made things worse; else empty."""
        if self.falls_back:
            return (
                f"the fit made the volume worse: it explains the slices with a residual of {self.volume:.3f}, the "
                f"prior volume with {self.prior:.3f}, which is written in its place; look at the registration"
            )
        if self.coarse < (1 - EQUAL) * self.volume:
            return (
                f"the mean of the slices explains them better (residual {self.coarse:.3f}) than the fit does "
                f"({self.volume:.3f}); look at the registration"
            )
        return ""


def check_volume(
    volume: NDArray[np.float32],
    prior: NDArray[np.float32],
    coarse: NDArray[np.float32],
    *,
    support: NDArray[np.bool_],
    grid: VolumeGrid,
    slices: Slices,
    slices_before: Slices,
    weight: NDArray[np.float64],
) -> VolumeCheck:
    """Compare the mixture with the volumes that it started from, by slices that all of them have seen.

    Slices held out of the fit alone would not be fair to the fit: V_prior and V_coarse have seen them.

    Args:
        volume: the finished one [I, J, K].
        prior: V_prior as it would be written [I, J, K].
        coarse: V_coarse [I, J, K].
        support: [I, J, K] of the brain; pixels that reach beyond it do not count, since the volume ends there.
        grid: of all these.
        slices: K slices in their last poses.
        slices_before: in the poses that V_prior and V_coarse were made with.
        weight: [K] slice weights.
    """
    (after,) = _residuals((volume,), support, grid, slices, weight)
    before = _residuals((prior, coarse), support, grid, slices_before, weight)
    return VolumeCheck(volume=after, prior=before[0], coarse=before[1])


def _residuals(
    volumes: Sequence[NDArray[np.float32]],
    support: NDArray[np.bool_],
    grid: VolumeGrid,
    slices: Slices,
    weight: NDArray[np.float64],
) -> list[float]:
    """Weighted errors after a gain for each slice and a bias field for each stack, relative to the intensities.

    Slices show the bias fields of their stacks. V_coarse and V_prior are means over the stacks and still contain the
    part that stacks share; the mixture does not. Without fields fitted to each volume, the one that is freest
    of them would explain least.

    Args:
        volumes: [I, J, K] each.
        support: [I, J, K].
        grid: of all these.
        slices: K slices.
        weight: [K].

    Returns:
        The relative error of each volume, 0 where no pixel counts. See `check_volume`.
    """
    index = slices.pixel_index[thinned(len(slices.pixel_index), MAX_PIXELS)]
    operator = VoxelOperator(slices.planes, grid, index)
    number, measured = operator.plane, slices.value[index].astype(np.float64)
    counts = weight[number] * (operator.forward(support.astype(np.float32)) > INSIDE)
    terms, stack_id = StackBiasField(slices).basis[:, index].astype(np.float64), slices.stack_id[number]
    all_of_it, found = counts @ measured**2, []
    for volume in volumes:
        shown = predicted = operator.forward(volume).astype(np.float64)
        for _ in range(N_ROUNDS):
            gain = best_gains(counts, shown, measured, number, len(slices), of_nothing=0)
            shown = predicted * _fields(gain[number] * predicted, measured, counts, stack_id, terms)
        fitted = best_gains(counts, shown, measured, number, len(slices), of_nothing=0)[number] * shown
        error = counts @ (fitted - measured) ** 2
        found.append(round(math.sqrt(error / all_of_it), 4) if all_of_it > 0 else 0.0)
    return found


def _fields(
    predicted: NDArray[np.float64],
    measured: NDArray[np.float64],
    counts: NDArray[np.float64],
    stack_id: NDArray[np.integer],
    terms: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The best bias field of its stack at each pixel [P], as a factor.

    Args:
        predicted: intensities [P].
        measured: intensities [P].
        counts: weights [P].
        stack_id: of each pixel [P].
        terms: of the fields [5, P], see `StackBiasField`.
    """
    field = np.ones_like(predicted)
    for stack in np.unique(stack_id):
        own = stack_id == stack
        root = np.sqrt(counts[own])
        design, error = root * terms[:, own] * predicted[own], root * (measured - predicted)[own]
        field[own] += np.linalg.lstsq(design @ design.T, design @ error, rcond=None)[0] @ terms[:, own]
    return field
