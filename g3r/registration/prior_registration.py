"""Slices of a single stack against the prior volume that was made from them.

A volume made of one stack alone repeats its errors, but the prior network has seen what heads look like: it
smooths out what jumps from slice to slice, and slices registered to it come nearer to each other.
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

logger = logging.getLogger(__name__)

N_STEPS = 4
"""Few on purpose, and once: repeated, still stacks drift by 0.1 mm a time."""

MIN_GAIN = 0.22
"""Share of the robust loss that registration must remove to be believed: 0.10 to 0.18 for stacks that lay
still (gains and noise), 0.26 to 0.32 for mild motion (docs/motion.md)."""


def register_to_prior(
    slices: Slices, gain: NDArray[np.float64], prior: NDArray[np.float32], grid: VolumeGrid
) -> tuple[Slices, NDArray[np.float64], bool]:
    """Move each slice a little towards where the prior has it.

    Args:
        slices: of one stack, in the prior's intensities.
        gain: [K] their intensity factors.
        prior: [I, J, K].
        grid: its grid.

    Returns:
        Slices, gains, and whether they were moved; those given where too little was gained.
    """
    model = SliceModel(slices, prior, grid, stride=max(1, len(slices.pixel_index) // 100_000))
    width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
    before = model.evaluate(slices.planes, gain, width)
    moved, new_gain, after = register_slices(model, slices, gain, n_steps=N_STEPS, width=width)
    size = before.moments[:, 0]
    removed = 1 - float(size @ after.loss) / max(float(size @ before.loss), 1e-30)
    logger.info("slices against the prior: %.0f %% of the loss removed", 100 * removed)
    return (moved, new_gain, True) if removed > MIN_GAIN else (slices, gain, False)
