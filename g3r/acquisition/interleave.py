"""The order in which the slices of a stack are acquired."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def acquisition_order(n_slices: int, interleave: int) -> NDArray[np.int64]:
    """Slice numbers in the order of acquisition: interleave 1 is sequential, 2 takes every second one first, and so on.

    Raises:
        ValueError: an interleave below 1.
    """
    if interleave < 1:
        raise ValueError(f"interleave {interleave}; expected at least 1")
    return np.concatenate([np.arange(first, n_slices, interleave) for first in range(interleave)])
