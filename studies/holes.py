"""Holes: missing slices of the stacks of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_synth.uneven_coverage import emptied
from g3r.acquisition.stacks import Stack


@dataclass(frozen=True)
class Hole:
    """A run of missing slices among the masked slices of one stack.

    Args:
        stack: number of the stack.
        first: start of the run, as a share of the masked slices.
        last: end of the run, as a share of the masked slices.
        n_slices: length in slices, in place of `last`.
    """

    stack: int
    first: float
    last: float = 1.0
    n_slices: int | None = None


def with_holes(stacks: Sequence[Stack], holes: Sequence[Hole]) -> tuple[Stack, ...]:
    """The stacks with the slices of the holes blanked: zeros with empty masks.

    Args:
        stacks: complete stacks.
        holes: at most one per stack.
    """
    result = list(stacks)
    for hole in holes:
        masked = np.flatnonzero(stacks[hole.stack].mask.any((0, 1)))
        first = round(hole.first * len(masked))
        end = round(hole.last * len(masked)) if hole.n_slices is None else first + hole.n_slices
        chosen = masked[first:end]
        if len(chosen):
            result[hole.stack] = emptied(stacks[hole.stack], int(chosen[0]), int(chosen[-1]) + 1)
    return tuple(result)
