"""Trends of the slices' gains along their stack, of which slices determine only how stacks differ.

A volume that is shaded along an axis, and gains that rise along the stack across it, explain the same pixels; in plane
the fields of the other stacks do the rest. Registration has found gains from the slices alone. A fit that may change
their trends freely follows whatever pulls at the volume, such as the brightness of V_prior: on a simulated head by 5 %
from end to end, which cost 0.7 dB. A ridge, as that of the fields, keeps this part where it was.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bias_basis import LENGTH_MM
from g3r.acquisition.planes import Slices

ORDER = 2
"""Of the polynomial along a stack, as that of a field in plane."""


class GainTrends:
    """A polynomial of second order, without a constant, along each stack.

    Args:
        slices: K slices; where their headers put them decides.
    """

    def __init__(self, slices: Slices) -> None:
        header = slices.header_pose
        self._of_stack: list[tuple[NDArray[np.intp], NDArray[np.float64]]] = []
        for stack in np.unique(slices.stack_id):
            rows = np.flatnonzero(slices.stack_id == stack)
            along = header.translation_mm[rows] @ header.rotation[rows[0], :, 2] / LENGTH_MM
            self._of_stack.append((rows, np.asarray(np.linalg.pinv(_centred_powers(along)))))

    def penalty(self, change: NDArray[np.floating]) -> tuple[float, NDArray[np.float64]]:
        """Mean squared coefficient of the trends, log-intensities at `LENGTH_MM`, and its gradient [K].

        Args:
            change: [K] of log-gains since the start.
        """
        coefficients = [inverse @ change[rows] for rows, inverse in self._of_stack]
        n, gradient = max(1, sum(len(one) for one in coefficients)), np.zeros(len(change))
        for (rows, inverse), own in zip(self._of_stack, coefficients, strict=True):
            gradient[rows] = 2 / n * own @ inverse
        return float(sum(own @ own for own in coefficients)) / n, gradient


def _centred_powers(along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Powers [n, up to 2] of some places, each without its mean."""
    n_terms = min(ORDER, len(np.unique(along)) - 1)
    powers = (along - along.mean())[:, None] ** np.arange(1, n_terms + 1)
    return powers - powers.mean(0)
