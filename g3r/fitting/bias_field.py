"""Smooth multiplicative bias field of each stack (receive-coil inhomogeneity), where the stacks determine it.

The coil is fixed while the fetus moves, so the field belongs to a stack's header frame. Its logarithm is
a polynomial of second order in the stack's in-plane coordinates without a constant; what varies from slice to
slice is the slices' gain. Stacks of different orientation see the same tissue under different fields, which
determines the fields up to what they share; a small ridge keeps that part at zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bias_basis import LENGTH_MM, N_TERMS, quadratic_terms, stacks_by_header
from g3r.acquisition.planes import Slices


class StackBiasField:
    """Log-fields of all stacks, linear in coefficients [n_stacks, 5].

    The terms, `basis` [5, P], are x, y, x^2, xy, y^2, each with zero mean over a stack's masked pixels.

    Args:
        slices: pixels and header poses.
    """

    def __init__(self, slices: Slices) -> None:
        self.stacks = np.unique(slices.stack_id)
        basis = np.zeros((slices.planes.n_pixels, N_TERMS), np.float32)
        self.ranges: list[tuple[int, int]] = []
        for pixels, inside, world_mm, axes in stacks_by_header(slices):
            self.ranges.append((pixels.start, pixels.stop))
            if not inside.any():  # nothing determines its field: no terms
                continue
            terms = quadratic_terms(*((world_mm - world_mm[inside].mean(0)) @ axes / LENGTH_MM).T)
            basis[pixels] = terms - terms[inside].mean(0)
        self.basis = np.ascontiguousarray(basis.T)

    def log_field(self, coefficients: NDArray[np.floating]) -> NDArray[np.float32]:
        """Log-intensity of the field at every pixel [P]."""
        single = np.asarray(coefficients, dtype=np.float32)
        return np.concatenate([single[n] @ self.basis[:, a:b] for n, (a, b) in enumerate(self.ranges)])
