"""Slices that a stack of a study misses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_synth.uneven_coverage import emptied
from g3r.acquisition.stacks import Stack


@dataclass(frozen=True)
class Hole:
    """What one stack misses of its masked slices.

    Args:
        stack: number of the stack.
        first: where it begins, as a share of the masked slices.
        last: where it ends, as a share.
        n_slices: length in slices, in place of `last`.
    """

    stack: int
    first: float
    last: float = 1.0
    n_slices: int | None = None


def with_holes(stacks: Sequence[Stack], holes: Sequence[Hole]) -> tuple[Stack, ...]:
    """The stacks without the slices of the holes, which stay in them as zeros with empty masks.

    Args:
        stacks: whole.
        holes: at most one of each stack.
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
