"""How time grows with size: slopes between logarithms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

DECADE = 10.0


@dataclass(frozen=True)
class Exponent:
    """Slope of log(cost) over log(size), and the standard error of the slope.

    Attributes:
        value: cost grows as size to this power.
        spread: standard error; zero where there are but two sizes.
        n_sizes: that the line was laid through.
    """

    value: float
    spread: float
    n_sizes: int


def fitted_exponent(size: Sequence[float], cost: Sequence[float], largest_decade: bool = False) -> Exponent:
    """The straight line through the logarithms, by least squares.

    Args:
        size: ascending.
        cost: positive.
        largest_decade: whether only sizes within a factor of 10 of the largest count, so that the fixed cost
            of small sizes does not.

    Raises:
        ValueError: lists of different lengths, fewer than two sizes, or values that are not positive.
    """
    x, y = np.asarray(size, dtype=np.float64), np.asarray(cost, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 1:
        raise ValueError(f"{x.shape} sizes and {y.shape} costs; expected as many")
    if largest_decade:
        kept = x >= x.max(initial=0.0) / DECADE
        x, y = x[kept], y[kept]
    if len(x) < 2 or x.min() <= 0 or y.min() <= 0 or np.ptp(x) == 0:
        raise ValueError("expected two sizes or more, and positive sizes and costs")
    x, y = np.log(x), np.log(y)
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    spread = float(np.sqrt(rest @ rest / (len(x) - 2) / (x @ x))) if len(x) > 2 else 0.0
    return Exponent(slope, spread, len(x))
