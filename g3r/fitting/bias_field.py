"""Smooth multiplicative shading of each stack (receive-coil inhomogeneity), where stacks can tell it.

The coil stands still while the fetus moves, so the field belongs to a stack's header frame. Its logarithm is
a polynomial of second order in the stack's in-plane coordinates without a constant; what varies from slice to
slice is the slices' gain. Stacks of different orientation see the same tissue under different fields, which
determines the fields up to what they share; a small ridge keeps that part at zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices

LENGTH_MM = 40.0
"""Unit of the coordinates, about half a head: coefficients are log-intensities at that distance."""

N_TERMS = 5


class StackBiasField:
    """Log-fields of all stacks, linear in coefficients [n_stacks, 5].

    The terms, `basis` [5, P], are x, y, x^2, xy, y^2, each with zero mean over a stack's masked pixels.

    Args:
        slices: pixels and header poses.
    """

    def __init__(self, slices: Slices) -> None:
        planes = slices.planes.with_pose(slices.header_pose)
        plane = planes.plane_id()
        world = planes.pixel_world_mm()
        stack_of_pixel = slices.stack_id[plane]
        self.stacks = np.unique(slices.stack_id)
        basis = np.zeros((planes.n_pixels, N_TERMS), np.float32)
        self.ranges: list[tuple[int, int]] = []
        for stack in self.stacks:
            pixels = np.flatnonzero(stack_of_pixel == stack)
            start, end = int(pixels[0]), int(pixels[-1]) + 1  # slices of a stack stand together
            inside = slices.mask[start:end]
            self.ranges.append((start, end))
            if not inside.any():  # nothing tells its field: no terms
                continue
            axes = slices.header_pose.rotation[slices.stack_id == stack][0][:, :2]
            center = world[start:end][inside].mean(0)
            x, y = ((world[start:end] - center) @ axes / LENGTH_MM).T
            terms = np.stack([x, y, x * x, x * y, y * y], axis=1)
            basis[start:end] = terms - terms[inside].mean(0)
        self.basis = np.ascontiguousarray(basis.T)

    def log_field(self, coefficients: NDArray[np.floating]) -> NDArray[np.float32]:
        """Log-intensity of the field at every pixel [P]."""
        single = np.asarray(coefficients, dtype=np.float32)
        return np.concatenate([single[n] @ self.basis[:, a:b] for n, (a, b) in enumerate(self.ranges)])
