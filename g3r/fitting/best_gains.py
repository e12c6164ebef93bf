"""The gain of each slice by which a volume explains its pixels best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def best_gains(
    weight: NDArray[np.floating],
    predicted: NDArray[np.floating],
    measured: NDArray[np.floating],
    plane: NDArray[np.integer],
    n_slices: int,
    *,
    of_nothing: float,
) -> NDArray[np.float64]:
    """Factors g [K] that minimise sum_p w_p (g predicted_p - measured_p)^2 over the pixels of each slice.

    Args:
        weight: [P'] not negative.
        predicted: [P'] intensities of a volume.
        measured: [P'] intensities of the slices.
        plane: [P'] number of the slice of each pixel.
        n_slices: K.
        of_nothing: gain of slices for which the volume predicts nothing.
    """
    across, own = (np.bincount(plane, weight * predicted * one, n_slices) for one in (measured, predicted))
    return np.divide(across, own, out=np.full(n_slices, float(of_nothing)), where=own > 0)
