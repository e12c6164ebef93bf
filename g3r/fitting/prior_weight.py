"""How much of V_prior is in the written volume where slices are dense."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices

SINGLE_STACK_WEIGHT = 0.75
"""Of V_prior with one stack, whose poses nothing but V_prior checks."""

MAX_WEIGHT = 0.75
"""However large the pixels are."""

FEWEST_STEPS = 16
"""After fewer steps of the fit, where time or the user ended it, V_prior alone is better than any mixture."""


def prior_weight(at_one_pixel: float, slices: Slices, weight: NDArray[np.float64], brain_mm3: float) -> float:
    """Least weight of V_prior in the volume, from 0 to 1.

    Noise of the fit and errors of the network are different, so a mixture beats both. The fewer pixels there are for a
    volume, the less they determine it and the better V_prior is beside them; the weight that was best in simulated
    subjects falls with the root of their number (docs/method.md).

    Args:
        at_one_pixel: weight with one pixel per mm3; 0 leaves V_prior out.
        slices: with the pixels that were fitted.
        weight: [K] slice weights.
        brain_mm3: volume of the brain.
    """
    if slices.n_stacks == 1:
        return SINGLE_STACK_WEIGHT if at_one_pixel > 0 else 0.0
    pixels_per_mm3 = float(weight[slices.pixel_plane].sum()) / brain_mm3
    return min(at_one_pixel / math.sqrt(pixels_per_mm3), MAX_WEIGHT)


def ended_early(n_steps: int, n_asked: int) -> bool:
    """Whether a fit made too few of its steps for its Gaussians to be shown.

    Args:
        n_steps: made.
        n_asked: by the settings; a fit that is meant to be shorter than `FEWEST_STEPS` is shown.
    """
    return n_steps < min(FEWEST_STEPS, n_asked)
