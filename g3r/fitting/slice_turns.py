"""Parts of the slices for the steps of stage 2: each has slices of every stack, and a cycle of parts has all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.fitting.objective import ImageTerm, TermLoss

FEWEST_SLICES = 4
"""Fewest slices of a part; fewer slices are split into fewer parts."""


def slice_parts(stack_id: NDArray[np.integer], n_parts: int) -> list[NDArray[np.intp]]:
    """Parts that hold every slice once, each with every n-th slice of each stack.

    Neighbours are in different parts, so each part sees the whole head. The parts of a stack begin where those of
    the stack before ended, so that their sizes differ by one at most.

    Args:
        stack_id: [K] stack of each slice, in the order of the slices.
        n_parts: wanted; fewer where slices are few.

    Returns:
        Ascending numbers of the slices of each part.
    """
    n = max(1, min(n_parts, len(stack_id) // FEWEST_SLICES))
    part = np.empty(len(stack_id), np.intp)
    part[np.argsort(stack_id, kind="stable")] = np.arange(len(stack_id)) % n
    return [np.flatnonzero(part == number) for number in range(n)]


class SliceTurns:
    """The parts of the slices in turn, with the last residual of every slice.

    One part fits better or worse than another. So the loss that is compared from step to step is the mean over all
    slices, each with the residual of its last turn.

    Args:
        term: the slices' image term.
        stack_id: [K] stack of each slice.
        n_parts: steps in which every slice comes once.
    """

    def __init__(self, term: ImageTerm, stack_id: NDArray[np.integer], n_parts: int) -> None:
        self.term, self.parts = term, slice_parts(stack_id, n_parts)
        self.residual = np.zeros(len(stack_id))
        self._known = np.zeros(len(stack_id), bool)
        self._turn = 0

    def next(self) -> NDArray[np.intp]:
        """Numbers of the slices whose turn it is."""
        self._turn += 1
        return self.parts[(self._turn - 1) % len(self.parts)]

    def put(self, slices: TermLoss) -> None:
        """Store the residuals of the slices that a step has seen."""
        self.residual[slices.chosen] = slices.residual[slices.chosen]
        self._known[slices.chosen] = True

    def mean(self, slice_weight: NDArray[np.float64]) -> float:
        """The image term of all slices seen so far, by their last residuals and slice weights [K]."""
        return self.term.mean(self.residual, slice_weight, np.flatnonzero(self._known))

    @property
    def is_complete(self) -> bool:
        """Whether every slice has been seen."""
        return bool(self._known.all())

    def forget(self) -> None:
        """Drop all residuals: parameters went back to an earlier state."""
        self._known[:] = False
