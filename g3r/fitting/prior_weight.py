"""Weight of V_prior in the written volume, where slices are dense."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_problem import QUIET

SINGLE_STACK_WEIGHT = 0.75
"""Weight of V_prior with one stack, whose poses only V_prior checks."""

MAX_WEIGHT = 0.75
"""Upper bound of the weight, however large the pixels are."""

FEWEST_STEPS = 16
"""Fewest steps of a fit whose Gaussians are shown: after fewer, if time or the user ended it, V_prior alone is better
than any mixture."""

LAST_STEPS = 5
"""Number of last steps of the fit whose residuals give the noise of the slices."""

NORMAL_OVER_MEAN = math.sqrt(math.pi / 2)
"""Standard deviation of a normal distribution over its mean absolute value."""


def noise_of(fit: SliceFit) -> float:
    """Standard deviation of the residuals of the Gaussians, in normalised intensities; 0 before the fit."""
    last = [entry["image"] for entry in fit.history[-LAST_STEPS:]]
    return NORMAL_OVER_MEAN * float(np.mean(last)) if last else 0.0


def prior_weight(
    at_one_pixel: float, slices: Slices, weight: NDArray[np.float64], brain_mm3: float, noise: float
) -> float:
    """Least weight of V_prior in the volume, from 0 to 1.

    The noise of the fit and the errors of the network differ, so a mixture is better than either. The fewer
    pixels there are for a volume, and the noisier they are, the less they determine it and the better V_prior is beside
    them. The weight that was best in simulated subjects falls with the root of their number and rises with the root of
    their noise (docs/method.md).

    Args:
        at_one_pixel: weight with one pixel per mm3; 0 leaves V_prior out.
        slices: with the pixels that were fitted.
        weight: [K] slice weights.
        brain_mm3: volume of the brain.
        noise: standard deviation in normalised intensities; up to `QUIET` it changes nothing.
    """
    if slices.n_stacks == 1:
        return SINGLE_STACK_WEIGHT if at_one_pixel > 0 else 0.0
    pixels_per_mm3 = float(weight[slices.pixel_plane].sum()) / brain_mm3
    return min(at_one_pixel * math.sqrt(max(1.0, noise / QUIET) / pixels_per_mm3), MAX_WEIGHT)


def ended_early(n_steps: int, n_asked: int) -> bool:
    """Whether a fit made too few steps for its Gaussians to be shown.

    Args:
        n_steps: steps made.
        n_asked: by the settings; a fit that is meant to be shorter than `FEWEST_STEPS` is shown.
    """
    return n_steps < min(FEWEST_STEPS, n_asked)
