"""Stacks and single slices on another intensity scale, brought to the level of the others.

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

from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack

LEVEL_RANGE = 1.25
"""A level within this factor of the others' level is left unchanged; slice gains compensate for it."""

BRIGHT = 3.0
"""Typical intensity of a slice over the usual one of its stack, above which the slice is brought to it. Fluid is up to
2.5 times as bright as tissue. Dark slices are left: they may have lost their signal."""


def same_level(stacks: Sequence[Stack]) -> tuple[Stack, ...]:
    """The stacks, scaled to the usual typical intensity inside their masks, without slices that are much too bright.

    Stacks within `LEVEL_RANGE` of the usual level and without such slices (`BRIGHT`) are returned unchanged.
    `Stack.level` of the others are the factors that were applied.

    Args:
        stacks: of one head.
    """
    stacks = [_without_bright_slices(stack) for stack in stacks]
    typical = [_typical(stack) for stack in stacks]
    usual = float(np.exp(np.median(np.log(typical))))
    # the usual level of two stacks is halfway between them
    reach = math.sqrt(LEVEL_RANGE) if len(stacks) == 2 else LEVEL_RANGE
    return tuple(
        stack if 1 / reach <= usual / own <= reach else _multiplied(stack, usual / own)
        for stack, own in zip(stacks, typical, strict=True)
    )


def level_notes(stacks: Sequence[Stack]) -> list[str]:
    """A line for each stack that was brought to the level of the others, or that had slices that were too bright."""
    lines = []
    for stack in stacks:
        usual = float(np.median(stack.level))
        bright = np.flatnonzero(stack.level != usual)
        if usual != 1:
            lines.append(f"{stack.name}: intensities times {usual:.3g}, to match the other stacks")
        if len(bright):
            numbers = ", ".join(map(str, bright.tolist()))
            lines.append(
                f"{stack.name}: slices {numbers} darkened to the level of the others, more than {BRIGHT:g} times"
            )
    return lines


def gain_in_files(gain: NDArray[np.float64], slices: Slices, stacks: Sequence[Stack]) -> NDArray[np.float64]:
    """Gains [K] of slices relative to the intensities in their files.

    Args:
        gain: [K] of slices of stacks that were brought to one level.
        slices: [K].
        stacks: all of them.
    """
    levels = [np.broadcast_to(stack.level, stack.image.shape[2]) for stack in stacks]
    return gain / np.array([levels[n][k] for n, k in zip(slices.stack_id, slices.slice_index, strict=True)])


def _without_bright_slices(stack: Stack) -> Stack:
    """The stack with slices that are brighter than `BRIGHT` allows at the usual level of its slices."""
    positive = np.where(stack.mask & (stack.image > 0), stack.image, np.nan)
    shown = np.asarray(np.isfinite(positive).any((0, 1)))
    typical = np.ones(len(shown))
    typical[shown] = np.nanmedian(positive[:, :, shown], axis=(0, 1))
    usual = float(np.median(typical[shown]))
    factor = np.where(shown & (typical > BRIGHT * usual), usual / typical, 1.0)
    return stack if (factor == 1).all() else _multiplied(stack, factor)


def _typical(stack: Stack) -> float:
    """Median of the positive values inside the mask, which depends little on how much black or fluid is in it."""
    inside = stack.image[stack.mask]
    return float(np.median(inside[inside > 0]))


def _multiplied(stack: Stack, factor: float | NDArray[np.float64]) -> Stack:
    """The stack times a factor, or times one [K] for each slice."""
    return replace(stack, image=stack.image * np.float32(factor), level=stack.level * factor)
