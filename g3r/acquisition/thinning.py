"""Some of many pixels, spread evenly, for what a part of them tells well enough."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GOLDEN_RATIO = (5**0.5 - 1) / 2


def thinned(n: int, n_wanted: int) -> NDArray[np.int64]:
    """Numbers of some of n things in a row: one in each of `n_wanted` cells of nearly equal length; the same each time.

    Pixels are numbered row by row. With steps of one length, rows whose length shares a factor with the step would show
    the same few columns in every slice. So the place in a cell goes on by the golden ratio from cell to cell: of all
    numbers it is the farthest from fractions, and where a row is nearly in step, columns still change within a slice.

    Args:
        n: number of all, such as pixels.
        n_wanted: how many to take.

    Returns:
        [min(n, n_wanted)], ascending; all where n is not above `n_wanted`.
    """
    if n <= n_wanted:
        return np.arange(n)
    start = np.arange(n_wanted + 1) * n // n_wanted
    place = np.arange(n_wanted) * GOLDEN_RATIO % 1.0
    return start[:-1] + (place * np.diff(start)).astype(np.int64)
