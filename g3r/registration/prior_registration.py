"""Slices of a single stack registered to the prior volume that was made from them.

A volume made of one stack repeats its errors, but the prior network has learned what heads look like: it
smooths out jumps from slice to slice, and slices registered to it come nearer to each other.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.geometry import VolumeGrid
from g3r.registration.normal_equations import SliceModel
from g3r.registration.slice_registration import register_slices
from g3r.registration.thresholds import MIN_PRIOR_LOSS_REMOVED

logger = logging.getLogger(__name__)

N_STEPS = 4
"""Few on purpose, and not repeated: stacks without motion would drift by 0.1 mm each time."""


def register_to_prior(
    slices: Slices, gain: NDArray[np.float64], prior: NDArray[np.float32], grid: VolumeGrid
) -> tuple[Slices, NDArray[np.float64], bool]:
    """Move each slice a little towards where it fits the prior.

    Args:
        slices: of one stack, in the intensities of the prior.
        gain: [K] intensity factors.
        prior: [I, J, K].
        grid: its grid.

    Returns:
        Slices, gains, and whether they were moved; the given ones where the loss fell too little.
    """
    model = SliceModel(slices, prior, grid, stride=max(1, len(slices.pixel_index) // 100_000))
    width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
    before = model.evaluate(slices.planes, gain, width)
    moved, new_gain, after = register_slices(model, slices, gain, n_steps=N_STEPS, width=width)
    size = before.moments[:, 0]
    removed = 1 - float(size @ after.loss) / max(float(size @ before.loss), 1e-30)
    logger.info("slices against the prior: %.0f %% of the loss removed", 100 * removed)
    return (moved, new_gain, True) if removed > MIN_PRIOR_LOSS_REMOVED else (slices, gain, False)
