"""How much of V_prior is in the written volume where slices are dense."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_problem import QUIET

SINGLE_STACK_WEIGHT = 0.75
"""Of V_prior with one stack, whose poses nothing but V_prior checks."""

MAX_WEIGHT = 0.75
"""However large the pixels are."""

FEWEST_STEPS = 16
"""After fewer steps of the fit, where time or the user ended it, V_prior alone is better than any mixture."""

LAST_STEPS = 5
"""Of the fit, whose residuals say how noisy slices are."""

NORMAL_OVER_MEAN = math.sqrt(math.pi / 2)
"""Standard deviation of a normal distribution over its mean absolute value."""


def noise_of(fit: SliceFit) -> float:
    """Standard deviation of what the Gaussians left unexplained, in normalised intensities; 0 before the fit."""
    last = [entry["image"] for entry in fit.history[-LAST_STEPS:]]
    return NORMAL_OVER_MEAN * float(np.mean(last)) if last else 0.0


def prior_weight(
    at_one_pixel: float, slices: Slices, weight: NDArray[np.float64], brain_mm3: float, noise: float
) -> float:
    """Least weight of V_prior in the volume, from 0 to 1.

    Noise of the fit and errors of the network are different, so a mixture beats both. The fewer pixels there are for a
    volume, and the noisier they are, the less they determine it and the better V_prior is beside them; the weight that
    was best in simulated subjects falls with the root of their number and rises with that of their noise
    (docs/method.md).

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
    """Whether a fit made too few of its steps for its Gaussians to be shown.

    Args:
        n_steps: made.
        n_asked: by the settings; a fit that is meant to be shorter than `FEWEST_STEPS` is shown.
    """
    return n_steps < min(FEWEST_STEPS, n_asked)
