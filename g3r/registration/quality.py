"""How far the poses of each stack can be trusted, and what to say when they cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from g3r.acquisition.stacks import Stack
from g3r.registration.estimate import Registration

MIN_NCC = 0.75
"""Median correlation of a stack's slices with the volume below which its poses are called unsure: 0.93
and more for stacks in place, 0.8 under shading of 0.15, 0.4 to 0.73 for the worst stack of failures."""

MIN_HELD_OUT = 0.65
"""Correlation of a stack with a volume of the others, outline included, below which it counts as not
registered."""

MAX_DOWNWEIGHTED_SHARE = 0.6
"""Share of slices of a stack that fit badly above which its poses are called unsure; up to 0.4 in good
reconstructions of real stacks."""

DOWNWEIGHTED_BELOW = 0.5


@dataclass(frozen=True)
class StackQuality:
    """What speaks for the poses of one stack.

    Args:
        reliable: whether every figure is where it is for stacks that are registered; None for a single stack,
            which nothing checks.
        held_out_correlation: with a volume of the other stacks; None for a single stack.
        median_slice_ncc: of its slices with the volume of all; None without slices.
        downweighted_share: slices that weigh less than a half.
    """

    reliable: bool | None
    held_out_correlation: float | None
    median_slice_ncc: float | None
    downweighted_share: float

    def record(self) -> dict[str, Any]:
        """For run.json."""
        return asdict(self)


def stack_qualities(motion: Registration, n_stacks: int) -> list[StackQuality]:
    """One entry for each stack that was given, in their order."""
    found = []
    present = np.unique(motion.slices.stack_id).tolist()
    for n in range(n_stacks):
        of_stack = motion.slices.stack_id == n
        if n not in present:
            found.append(StackQuality(False, None, None, 0.0))
            continue
        held_out = None if motion.held_out is None else motion.held_out[present.index(n)]
        ncc = float(np.median(motion.ncc[of_stack]))
        downweighted = float((motion.weight[of_stack] < DOWNWEIGHTED_BELOW).mean())
        reliable = None
        if held_out is not None:
            reliable = held_out >= MIN_HELD_OUT and ncc >= MIN_NCC and downweighted <= MAX_DOWNWEIGHTED_SHARE
        found.append(StackQuality(reliable, held_out, ncc, downweighted))
    return found


def pose_warnings(motion: Registration, qualities: Sequence[StackQuality], stacks: Sequence[Stack]) -> list[str]:
    """A line for each stack that should not be trusted."""
    lines = []
    for stack, one in zip(stacks, qualities, strict=True):
        if one.median_slice_ncc is None:
            lines.append(f"{stack.name}: no slice with enough masked pixels; the stack was not used")
        elif one.reliable is False:
            lines.append(
                f"{stack.name}: registration probably failed (correlation with the other stacks "
                f"{one.held_out_correlation:.2f}, of its slices with the volume {one.median_slice_ncc:.2f}, "
                f"{one.downweighted_share:.0%} of its slices fit badly); do not trust the volume"
            )
    return lines


def registration_reliable(qualities: Sequence[StackQuality]) -> bool | None:
    """Whether all stacks are sure; None where nothing checks them (a single stack)."""
    if any(one.reliable is False for one in qualities):
        return False
    return True if all(one.reliable for one in qualities) else None


def registration_summary(qualities: Sequence[StackQuality]) -> str:
    """One line on all stacks."""
    if registration_reliable(qualities) is None:
        return "a single stack: no other stack checks where its slices lie"
    n_reliable = sum(bool(one.reliable) for one in qualities)
    figures = ", ".join(
        "none" if one.held_out_correlation is None else f"{one.held_out_correlation:.2f}" for one in qualities
    )
    return f"{n_reliable} of {len(qualities)} stacks are registered; correlation with the others: {figures}"
