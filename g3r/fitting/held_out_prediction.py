"""Held-out slices of a short fit: how well it predicts them, and the widths of stacks relative to each other.

The cloud was fitted with one width for all stacks. If the slices of one stack are narrower than that, and the others
are not, the cloud is as sharp as the others require, and slices of this stack are predicted best with a narrower
profile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.best_gains import best_gains
from g3r.gaussians import GaussianCloud, render

STRETCHES = (0.5, 0.6, 0.72, 0.85, 1.0, 1.18, 1.4, 1.65, 2.0)
"""Widths over that of the fit with which held-out slices are rendered."""

MIN_CONTRAST = 0.003
"""Least rise of the error, relative to its minimum, over the widths tried, for the minimum to count."""

MIN_HELD_OUT = 3
"""Fewest held-out slices that determine anything."""


@dataclass(frozen=True)
class HeldOutFit:
    """A short fit and the slices that were held out of it.

    Attributes:
        cloud: the fitted Gaussians.
        slices: the held-out slices, with the profile of the fit.
        share: [P'] of brain in their masked pixels.
        field: [P'] bias field of their stacks there, as the fit found it.
    """

    cloud: GaussianCloud
    slices: Slices
    share: NDArray[np.float32]
    field: NDArray[np.float32]

    def errors(self, stretch: float = 1.0) -> NDArray[np.float64]:
        """[P'] absolute errors of masked pixels after one gain per slice, in the units of the measured pixels.

        Args:
            stretch: width of the slice profile, through the plane, over the one of the fit.
        """
        index = self.slices.pixel_index
        planes = self.slices.planes
        number = planes.plane_id()[index]
        planes = replace(planes, psf_var_mm2=planes.psf_var_mm2 * np.array([1, 1, stretch**2]))
        predicted, measured = render(self.cloud, planes).numpy()[index] * self.field, self.slices.value[index]
        gain = best_gains(self.share, predicted, measured, number, len(self.slices), of_nothing=1)
        off: NDArray[np.float64] = np.abs(gain[number] * predicted - measured)
        # times the share, by which the pixel was divided when its surroundings were taken out
        return self.share * off

    def relative_widths(self, stack_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Width of each stack's profile [N], through the plane, over that of the fit; their geometric mean is 1.

        1 for all if a stack has too few held-out slices, or no clear minimum.

        Args:
            stack_ids: [N] of the run's stacks, ascending, with or without held-out slices.
        """
        stack = np.searchsorted(stack_ids, self.slices.stack_id)
        n_stacks = len(stack_ids)
        unknown = np.ones(n_stacks)
        if n_stacks == 1 or np.bincount(stack, minlength=n_stacks).min() < MIN_HELD_OUT:
            return unknown
        stack_of_pixel = stack[self.slices.pixel_plane]
        pixels = np.bincount(stack_of_pixel)
        error = [np.bincount(stack_of_pixel, self.errors(stretch)) / pixels for stretch in STRETCHES]
        found = [lowest(STRETCHES, of_stack) for of_stack in np.array(error).T]
        widths = np.array([width for width in found if width is not None])
        return widths / np.exp(np.log(widths).mean()) if len(widths) == n_stacks else unknown


def lowest(widths: Sequence[float], error: Sequence[float] | NDArray[np.float64]) -> float | None:
    """Width of the lowest error, by a parabola in the log width through its neighbours; None if all are alike.

    Args:
        widths: three or more, rising.
        error: of each.
    """
    if not max(error) > (1 + MIN_CONTRAST) * min(error):
        return None
    best = int(np.argmin(error))
    middle = min(max(best, 1), len(widths) - 2)
    three = slice(middle - 1, middle + 2)
    curvature, slope, _ = np.polyfit(np.log(widths[three]), error[three], 2)
    if curvature <= 0:
        return float(widths[best])
    half_step = math.sqrt(widths[1] / widths[0])
    return min(max(math.exp(-slope / (2 * curvature)), widths[0] / half_step), widths[-1] * half_step)
