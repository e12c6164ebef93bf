"""Registration of the slices of a single stack to the prior volume that was made from them.

A volume made of one stack repeats its errors, but the prior network has learned what heads look like: it
smooths out jumps from slice to slice, and slices registered to it come nearer to each other. Volume and slices are
found in turn, so moves may be made longer (over-relaxation). Neither determines how long the head is along the stack:
without a constraint, slices drift apart there, move by move.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.slice_registration import register_slices
from g3r.registration.slice_rounds import OVER_RELAXATION, carried_on
from g3r.registration.thresholds import MIN_PRIOR_LOSS_REMOVED

logger = logging.getLogger(__name__)

N_STEPS = 4
"""Steps of registration, few on purpose: stacks without motion would drift by 0.1 mm each time."""


def register_to_prior(
    slices: Slices, gain: NDArray[np.float64], prior: NDArray[np.float32], grid: VolumeGrid
) -> tuple[Slices, NDArray[np.float64], bool]:
    """Move each slice towards where it fits the prior, and a little further.

    Args:
        slices: of one stack, in the intensities of the prior.
        gain: [K] intensity factors.
        prior: [I, J, K].
        grid: its grid.

    Returns:
        Slices, gains, and whether they were moved; the given ones where too little of the loss was removed.
    """
    model = SampledSlices(slices, prior, grid, n_pixels=100_000)
    width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
    before = model.evaluate(slices.planes, gain, width)
    moved, new_gain, after = register_slices(model, slices, gain, n_steps=N_STEPS, width=width)
    size = before.moments[:, 0]
    removed = 1 - float(size @ after.loss) / max(float(size @ before.loss), 1e-30)
    logger.info("slices against the prior: %.0f %% of the loss removed", 100 * removed)
    if removed <= MIN_PRIOR_LOSS_REMOVED:
        return slices, gain, False
    return without_stretch(slices, carried_on(slices, moved, OVER_RELAXATION)), new_gain, True


def without_stretch(before: Slices, after: Slices) -> Slices:
    """The moved slices, without the part of their moves that stretches or squeezes the stack along its normal.

    Args:
        before: slices of one stack before the moves.
        after: the same slices after them.
    """
    move = before.planes.pose.inverse() @ after.planes.pose
    along_mm = move.translation_mm[:, 2]
    header = before.header_pose
    place_mm = header.translation_mm @ header.rotation[0, :, 2]
    n_pixels = np.bincount(before.pixel_plane, minlength=len(before)).astype(np.float64)
    place_mm = place_mm - np.average(place_mm, weights=n_pixels)
    spread = float(n_pixels @ place_mm**2)
    stretch = float((n_pixels * place_mm) @ along_mm) / spread if spread > 0 else 0.0
    kept = RigidPose(move.rotation, move.translation_mm - np.outer(stretch * place_mm, [0, 0, 1]))
    return after.with_pose(before.planes.pose @ kept)
