"""A first estimate of each stack's bias field from its own intensities, before any pose is known.

Receive coils make one side of a stack brighter. Registration compares intensities of stacks with different
bias fields, and a field of 15 % already moves whole stacks to wrong places. A second-order polynomial fitted
to the log intensities of a stack removes it together with the slow trend of the anatomy, which registration
does not need. Only registration uses the corrected slices: the fit to the slices models the field itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bias_basis import LENGTH_MM, N_TERMS, quadratic_terms, stacks_by_header
from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width

MIN_INTENSITY = 0.1
"""Lower bound of a pixel before the logarithm is taken, as a share of the stack's mean intensity."""

FIELD_RANGE = (0.4, 2.5)
"""A field outside this range is an extrapolation of the fit, not the field of a coil."""

N_ROUNDS = 10

FITTED_PIXELS = 20_000
"""Number of evenly spread pixels of a stack that are fitted; five coefficients need no more."""


def bias_corrected(slices: Slices) -> Slices:
    """The slices with the slow in-plane trend of each stack's intensities divided out.

    The trend is quadratic in the header frame of the stack, about the middle of its masked pixels. It is
    fitted to log intensities, Cauchy-weighted so that anatomy far from the mean counts little; slices keep
    their gains.
    """
    value = slices.value.copy()
    for pixels, inside, world_mm, axes in stacks_by_header(slices):
        in_plane = world_mm @ axes / LENGTH_MM
        terms = quadratic_terms(*(in_plane - in_plane[inside].mean(0)).T)
        bright = slices.value[pixels].astype(np.float64)
        level = float(bright[inside].mean())
        if not level > 0:
            continue
        some = np.flatnonzero(inside)
        some = some[np.linspace(0, len(some) - 1, min(len(some), FITTED_PIXELS)).astype(int)]
        coefficients = _robust_fit(terms[some], np.log(np.maximum(bright[some], MIN_INTENSITY * level)))
        value[pixels] = bright / np.exp(terms @ coefficients).clip(*FIELD_RANGE)
    return replace(slices, value=value.astype(np.float32))


def _robust_fit(terms: NDArray[np.float64], log_value: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients [5] of the terms [P, 5], fitted with a free constant."""
    basis = np.c_[terms, np.ones(len(terms))]
    weight = np.ones(len(basis))
    ridge = 1e-6 * len(basis) * np.eye(basis.shape[1])  # a stack that is a line of pixels does not determine y
    for _ in range(N_ROUNDS):
        weighted = basis * weight[:, None]
        found = np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ log_value)
        residual = log_value - basis @ found
        weight = 1 / (1 + (residual / robust_width(residual)) ** 2)
    return found[:N_TERMS]
