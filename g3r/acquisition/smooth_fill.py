"""A smooth continuation of a volume into what was not measured: what is known without any other brain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

FIRST_SIGMA_VOXELS = 1.5
LEAST_WEIGHT = 0.05
"""Share of measured surroundings from which a mean is taken; with less, the next wider surroundings are asked."""


def smooth_fill(
    values: NDArray[np.float32], weight: NDArray[np.float32], share: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Where the weight is low, the weighted mean of the nearest surroundings that were measured.

    Normalised convolution with Gaussians of doubling width (Knutsson & Westin 1993): the narrowest that finds
    measured voxels is taken.

    Args:
        values: [I, J, K].
        weight: [I, J, K] from 0 (unknown) to 1 (measured).
        share: [I, J, K] of each voxel in the means of its surroundings, 0 to 1: that of brain, so that what lies
            outside of the head does not darken it; None takes all of it.

    Returns:
        [I, J, K]: `weight * values + (1 - weight) * surroundings`, zero where nothing is near.
    """
    source = weight if share is None else weight * share
    around, missing = np.zeros_like(values), np.ones(values.shape, np.float32)
    sigma = FIRST_SIGMA_VOXELS
    while sigma < max(values.shape) and missing.any():
        mean_weight = gaussian_filter(source, sigma)
        mean = gaussian_filter(source * values, sigma) / np.maximum(mean_weight, 1e-6)
        found = np.clip(mean_weight / LEAST_WEIGHT, 0, 1) * missing
        around += found * mean
        missing -= found
        sigma *= 2
    return weight * values + (1 - weight) * around
