"""Divergence guard: when the loss of a fit rises, it restores the best state and goes on with shorter steps."""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import NDArray

from g3r.errors import NumericalError
from g3r.fitting.parameters import FitParameters

logger = logging.getLogger(__name__)

RISE = 1.5
"""A loss is too high only if it is more than this many times the best one. `LEVEL_SHARE` must be exceeded, too."""

LEVEL_SHARE = 0.15
"""Rise above the best loss, over the mean absolute pixel, beyond which a loss is too high. Fits that go well rise by up
to 0.05 of it (they begin at a least-squares optimum of the amplitudes, and the loss is L1), with ten times the step
sizes by 0.4 (docs/numerics.md)."""

SHORTER = 0.3
"""Factor of all step sizes after each rollback, for the rest of the fit."""

KEEP_EVERY = 5
"""Fewest steps between two copies of the parameters; a copy is made only if the loss is the lowest so far."""


class DivergenceGuard:
    """Takes the steps of a fit, and rolls it back when the loss rises or is not finite.

    The parameters with the lowest loss are kept, in one copy that is renewed every few steps at most. A loss
    that has risen too far, or a loss or gradient that is not finite, restores them; step sizes are reduced and
    Adam begins anew. A fit in which that does not happen takes the same steps as without the guard.

    Args:
        parameters: of the fit.
        level: mean absolute value of the pixels, in the units of the loss.
    """

    def __init__(self, parameters: FitParameters, level: float) -> None:
        self.parameters, self.level = parameters, level
        self.step_factor = 1.0
        self.n_back = 0
        self._best_loss = math.inf
        self._last_loss = math.inf
        self._best: NDArray[np.float32] | None = None
        self._age = KEEP_EVERY

    def step(self, loss: float, factor: float) -> bool:
        """Take a step down the gradient of a loss, or roll back to the best state; returns whether it went forward.

        Args:
            loss: at the present parameters, whose gradient they hold.
            factor: of the step sizes, by the fit's schedule.

        Raises:
            NumericalError: a loss or gradient that is not finite before there was a finite one.
        """
        too_high = max(RISE * self._best_loss, self._best_loss + LEVEL_SHARE * self.level)
        if self._best is not None and not loss <= too_high:
            return self._back(loss)
        self._keep(loss)
        try:
            self.parameters.step(loss, factor * self.step_factor)
        except NumericalError:
            if self._best is None:
                raise
            return self._back(loss)
        self._last_loss = loss
        return True

    def rescale(self, ratio: float) -> None:
        """Account for a new definition of the loss, under which it is `ratio` times what it was."""
        if math.isfinite(ratio) and ratio > 0:
            self._best_loss *= ratio
            self._last_loss *= ratio

    def finish(self) -> None:
        """Leave the parameters at the best state if the fit was rolled back and did not reach that loss again."""
        values = self.parameters.values
        risen = self.n_back > 0 and not self._last_loss <= self._best_loss
        if self._best is not None and (risen or not np.isfinite(values).all()):
            values[:] = self._best

    def _keep(self, loss: float) -> None:
        due = self._age >= KEEP_EVERY and loss < self._best_loss
        self._age += 1
        if due and np.isfinite(self.parameters.gradients).all():
            if self._best is None:
                self._best = np.empty_like(self.parameters.values)
            self._best[:] = self.parameters.values
            self._best_loss, self._age = loss, 1

    def _back(self, loss: float) -> bool:
        assert self._best is not None
        self.parameters.restart(self._best)
        self.step_factor *= SHORTER
        self.n_back += 1
        self._last_loss = math.inf
        logger.warning(
            "loss rose from %.4g to %.4g: back to the best state, steps at %.3g of their size",
            self._best_loss,
            loss,
            self.step_factor,
        )
        return False
