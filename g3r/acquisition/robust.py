"""Robust statistics of residuals: a width from the median, and weights for slices that fit badly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIGMA_PER_MAD = 1.4826
"""Standard deviation of normal residuals in units of their median absolute value."""

MAX_DROPPED_SHARE, DROPPED_WEIGHT = 0.2, 0.1
"""At most this share of the slices may weigh less than `DROPPED_WEIGHT`; where more fit badly, poses are at fault. In a
single stack no slice may: no other slice shows the same place, so a volume without it fits it worse and worse. This
used to lose the ends of stacks, where slices hold few pixels. A slice with a tenth of the weight still decides where no
other slice contradicts it."""

DARK = 0.5
"""Share of the median gain below which a slice weighs less, by the square of gain over this limit, as its noise grows
relative to its signal. A gain near zero explains a slice without signal whatever the volume, so the residual cannot
detect it."""

MIN_WEIGHT = 1e-3
"""Smallest weight of a slice, so that no weight is zero."""


def robust_width(residual: NDArray[np.floating], n_sigma: float = 1.0, floor: float = 1e-6) -> float:
    """A multiple of the robust standard deviation (1.4826 MAD) of residuals with median zero, plus a floor.

    Args:
        residual: of any shape.
        n_sigma: how many standard deviations.
        floor: added, so that a perfect fit does not divide by zero.
    """
    return n_sigma * SIGMA_PER_MAD * float(np.median(np.abs(residual))) + floor


def slice_weights(loss: NDArray[np.float64], gain: NDArray[np.float64], n_stacks: int) -> NDArray[np.float64]:
    """Weight of each slice [K], lower where its mean robust loss is unusually large, or where it is dark.

    1 up to the median plus twice the robust spread, then the Geman-McClure form. A large loss takes at most
    `MAX_DROPPED_SHARE` of the slices below `DROPPED_WEIGHT`, and none of a single stack. Dark slices weigh less still
    (`DARK`). No weight is below `MIN_WEIGHT`.

    Args:
        loss: [K] of the slices.
        gain: [K] their intensity factors.
        n_stacks: number of stacks that they belong to.
    """
    median = np.median(loss)
    spread = robust_width(loss - median, floor=0.0) + 0.05 * median + 1e-12
    excess = np.maximum(0.0, (loss - median) / spread - 2.0)
    weight = np.maximum(1.0 / (1.0 + (excess / 2.0) ** 2) ** 2, MIN_WEIGHT)
    n_dropped = int(MAX_DROPPED_SHARE * len(weight)) if n_stacks > 1 else 0
    by_weight = np.argsort(weight, kind="stable")
    kept = by_weight[n_dropped:]
    weight[kept] = np.maximum(weight[kept], DROPPED_WEIGHT)
    light = np.minimum(1.0, gain / (DARK * np.median(gain))) ** 2
    return np.maximum(weight * light, MIN_WEIGHT)
