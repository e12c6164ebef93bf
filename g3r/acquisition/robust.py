"""Robust statistics of residuals: a width from the median, and weights for slices that fit badly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIGMA_PER_MAD = 1.4826
"""Standard deviation of normal residuals in units of their median absolute value."""

MAX_DROPPED_SHARE, DROPPED_WEIGHT = 0.2, 0.1
"""At most this share of the slices may weigh less than `DROPPED_WEIGHT`; where more fit badly, poses are at fault. Of a
single stack none: nothing else saw what such a slice shows, so a volume without it fits it worse and worse. Ends of a
stack, where little is seen, were lost so. A slice with a tenth of the weight decides where no other contradicts it."""

DARK = 0.5
"""Share of the usual gain below which a slice weighs less, by the square of it: its noise over its signal. A slice that
lost its signal is explained by a gain near zero whatever the volume, so its residual does not give it away."""

MIN_WEIGHT = 1e-3
"""Of a slice: never zero."""


def robust_width(residual: NDArray[np.floating], n_sigma: float = 1.0, floor: float = 1e-6) -> float:
    """A number of robust standard deviations (1.4826 MAD) of residuals with median zero, plus a floor.

    Args:
        residual: of any shape.
        n_sigma: how many standard deviations.
        floor: added, so that a perfect fit does not divide by zero.
    """
    return n_sigma * SIGMA_PER_MAD * float(np.median(np.abs(residual))) + floor


def slice_weights(loss: NDArray[np.float64], gain: NDArray[np.float64], n_stacks: int) -> NDArray[np.float64]:
    """Weight of each slice [K], lower where its mean robust loss is unusually large, or where it is dark.

    1 up to the median plus twice the robust spread, then the Geman-McClure form; never zero, and for its loss below
    `DROPPED_WEIGHT` for at most `MAX_DROPPED_SHARE` of the slices, for none of a single stack. For dark slices see
    `DARK`.

    Args:
        loss: [K] of the slices.
        gain: [K] their intensity factors.
        n_stacks: that they belong to.
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
