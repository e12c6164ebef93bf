"""Schedules of weights and step sizes during a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from g3r.errors import InputError

HOLD, FLOOR = 0.4, 0.05
"""Fraction of a fit up to which steps have their full size, and their size at its end over the full one."""


@dataclass(frozen=True)
class AnnealedWeight:
    """w(i): `start` until tau_1, linear to `end` at tau_2, `end` from there (G3R Eq. 9).

    Args:
        start, end: weights, not negative.
        tau_1, tau_2: fractions of the fit in [0, 1], tau_1 <= tau_2; equal makes a step.

    Raises:
        InputError: a negative weight, or fractions reversed or outside [0, 1].
    """

    start: float
    end: float
    tau_1: float = 0.2
    tau_2: float = 0.8

    def __post_init__(self) -> None:
        if not (self.start >= 0 and self.end >= 0 and math.isfinite(self.start) and math.isfinite(self.end)):
            raise InputError(f"distillation weights {self.start}, {self.end}; expected finite and not negative")
        if not 0 <= self.tau_1 <= self.tau_2 <= 1:
            raise InputError(f"distillation tau_1 {self.tau_1}, tau_2 {self.tau_2}; expected 0 <= tau_1 <= tau_2 <= 1")

    def at(self, fraction: float) -> float:
        """The weight at a fraction of the fit."""
        if fraction < self.tau_1:
            return self.start
        if fraction >= self.tau_2:
            return self.end
        along = (fraction - self.tau_1) / (self.tau_2 - self.tau_1)
        return self.start + along * (self.end - self.start)


def cosine_decay(fraction: float) -> float:
    """Step size factor at a fraction of a fit: 1 until `HOLD`, then half a cosine down to `FLOOR` at the end."""
    if fraction < HOLD:
        return 1.0
    along = (fraction - HOLD) / (1 - HOLD)
    return FLOOR + (1 - FLOOR) * 0.5 * (1 + math.cos(math.pi * along))


def prior_strength(schedule: AnnealedWeight, prior_error: float, fraction: float, residual: float) -> float:
    """w(i) of G3R Eq. 9: annealed, but not below what the slices' residual and the prior's error require.

    A voxel with confidence c counts as if 1 - c missing pixels had been read off the prior. Under L1 (Laplace
    distributions) the weight of a pixel is one over its mean absolute error, so a pixel read off the prior weighs
    residual / prior_error times a measured one: little where slices fit much better than the prior's error, much where
    noise or motion spoil them.

    Args:
        schedule: the annealed weight.
        prior_error: mean absolute error of the prior; with 0 the schedule alone decides.
        fraction: of the fit that is done.
        residual: mean absolute residual of the slices at present.
    """
    annealed = schedule.at(fraction)
    if prior_error <= 0 or not schedule.start > 0:
        return annealed
    return max(annealed, min(residual / prior_error, 1.0))  # at most that of a measured pixel
