"""Stacks on another intensity scale, brought to the level of the others.

Scanners choose a receiver gain for each stack, and programs rescale what they write. Slice gains are searched for near
1, and a slice that is much darker than most is down-weighted, because a slice that lost its signal is as dark. So a
stack at a third of the others' level would be taken for a misfit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.stacks import Stack

LEVEL_RANGE = 1.25
"""A level within this factor of the others' level is left unchanged; slice gains compensate for it."""


def same_level(stacks: Sequence[Stack]) -> tuple[Stack, ...]:
    """The stacks, scaled to the usual typical intensity inside their masks.

    Stacks within `LEVEL_RANGE` of the usual level are returned unchanged. `Stack.level` of the others is the factor
    that was applied.

    Args:
        stacks: of one head.
    """
    typical = [_typical(stack) for stack in stacks]
    usual = float(np.exp(np.median(np.log(typical))))
    # the usual level of two stacks is halfway between them
    reach = math.sqrt(LEVEL_RANGE) if len(stacks) == 2 else LEVEL_RANGE
    return tuple(
        stack if 1 / reach <= usual / own <= reach else _multiplied(stack, usual / own)
        for stack, own in zip(stacks, typical, strict=True)
    )


def level_notes(stacks: Sequence[Stack]) -> list[str]:
    """A line for each stack that was brought to the level of the others."""
    return [
        f"{one.name}: intensities times {one.level:.3g}, to match the other stacks" for one in stacks if one.level != 1
    ]


def gain_in_files(
    gain: NDArray[np.float64], stack_id: NDArray[np.int64], stacks: Sequence[Stack]
) -> NDArray[np.float64]:
    """Gains [K] of slices relative to the intensities in their files.

    Args:
        gain: [K] of slices of stacks that were brought to one level.
        stack_id: [K] number of each slice's stack.
        stacks: all of them.
    """
    return gain / np.array([stack.level for stack in stacks])[stack_id]


def _typical(stack: Stack) -> float:
    """Median of the positive values inside the mask, which depends little on how much black or fluid is in it."""
    inside = stack.image[stack.mask]
    return float(np.median(inside[inside > 0]))


def _multiplied(stack: Stack, factor: float) -> Stack:
    return replace(stack, image=stack.image * np.float32(factor), level=stack.level * factor)
