"""Quality of the registration of one stack, and its shortfalls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from decimal import ROUND_FLOOR, Decimal
from typing import Any

from g3r.registration.thresholds import (
    IN_PLACE_NCC,
    IN_PLACE_SHARE,
    LEEWAY,
    MAX_DOWNWEIGHTED_SHARE,
    MAX_NCC_BELOW_OTHERS,
    MIN_HELD_OUT,
    MIN_MISFIT_WITHOUT,
    MIN_NCC,
    MIN_OVERLAP_CORRELATION,
    MIN_OVERLAP_SHARE,
    MIRRORED_BELOW,
)


@dataclass(frozen=True, kw_only=True)
class StackQuality:
    """Quality of the registration of one stack.

    Args:
        reliable: whether every figure is in the range of registered stacks; None for a single stack, which
            nothing checks.
        held_out_correlation: with a volume of the other stacks; None for a single stack.
        median_slice_ncc: of its slices with the volume of all; None without slices.
        downweighted_share: share of slices with a weight below one half.
        median_move_mm: movement of the head from one of its slices to the next in time, median (`head_movement`); None
            without slices.
        n_missing: number of missing slices between acquired ones.
        longest_gap_mm: length of the longest gap between acquired slices.
        is_cut: whether the field of view cut the head.
        overlap_share: share of its pixels that other stacks saw; None for a single stack, and where no stack
            lacks slices.
        overlap_correlation: with the other stacks over those pixels.
        handedness: whether it shows the asymmetry of the head as the others do (`registration.handedness`); None where
            it was not computed or is unknown.
        misfit_without: share of the misfit of the other stacks that is left without it (`registration.intruder`); None
            where it was not computed, or less is left without another stack.
        left_out: whether the volume was made without it, since it does not fit the others (`registration.misfits`);
            then the figures are those of the registration with it.
    """

    reliable: bool | None
    held_out_correlation: float | None
    median_slice_ncc: float | None
    downweighted_share: float
    median_move_mm: float | None = None
    n_missing: int = 0
    longest_gap_mm: float = 0.0
    is_cut: bool = False
    overlap_share: float | None = None
    overlap_correlation: float | None = None
    handedness: float | None = None
    misfit_without: float | None = None
    left_out: bool = False

    def record(self) -> dict[str, Any]:
        """For run.json."""
        return asdict(self)


def is_mirrored(one: StackQuality) -> bool:
    """Whether the stack seems to be a mirror image of what the others show."""
    return one.handedness is not None and one.handedness < MIRRORED_BELOW


def rounded_down(value: float | None) -> str:
    """With two decimals, rounded down, so that a value just below a limit does not read as equal; "none" for None."""
    return "none" if value is None else str(Decimal(str(value)).quantize(Decimal("0.01"), ROUND_FLOOR))


def shortfalls(one: StackQuality) -> list[str]:
    """Figures of a stack that are worse than those of registered stacks, each with the good range; empty if none is."""
    found = []
    leeway = LEEWAY if _in_place(one) else 0.0
    least, least_overlap = MIN_HELD_OUT - leeway, MIN_OVERLAP_CORRELATION - leeway
    if one.held_out_correlation is not None and one.held_out_correlation < least:
        found.append(f"agreement {one.held_out_correlation:.3g}; good is {MIN_HELD_OUT:g} and above")
    if one.median_slice_ncc is not None and one.median_slice_ncc < MIN_NCC:
        found.append(f"its slices agree with the volume by {one.median_slice_ncc:.3g}; good is {MIN_NCC:g} and above")
    if one.downweighted_share > MAX_DOWNWEIGHTED_SHARE:
        good = f"good is {MAX_DOWNWEIGHTED_SHARE:.0%} or fewer"
        found.append(f"{100 * one.downweighted_share:.3g}% of its slices fit badly; {good}")
    # the template that was used for what others did not see agrees with any head
    if one.overlap_share is not None and one.overlap_share < MIN_OVERLAP_SHARE:
        found.append(f"others saw {100 * one.overlap_share:.3g}% of it; good is {MIN_OVERLAP_SHARE:.0%} and above")
    if one.overlap_correlation is not None and one.overlap_correlation < least_overlap:
        good = f"good is {MIN_OVERLAP_CORRELATION:g} and above"
        found.append(f"agreement {one.overlap_correlation:.3g} where others saw it; {good}")
    if one.misfit_without is not None and one.misfit_without < MIN_MISFIT_WITHOUT:
        good = f"good is {1 - MIN_MISFIT_WITHOUT:.0%} or less"
        found.append(f"the other stacks fit each other {1 - one.misfit_without:.0%} better without it; {good}")
    return found


def _in_place(one: StackQuality) -> bool:
    """Whether slices fit a volume that others helped to make as well as only those of stacks in place do."""
    seen_by_others = one.overlap_share is None or one.overlap_share >= IN_PLACE_SHARE
    return one.median_slice_ncc is not None and one.median_slice_ncc >= IN_PLACE_NCC and seen_by_others


def unlike_others(qualities: Sequence[StackQuality]) -> list[int]:
    """Indices of stacks that passed every test of their own, but whose slices fit the volume less than the best do.

    Args:
        qualities: of stacks; those that were left out, had no slices, or failed are ignored.
    """
    ncc = [None if one.left_out else one.median_slice_ncc for one in qualities]
    best = max((one for one in ncc if one is not None), default=0.0)
    return [
        n
        for n, (own, one) in enumerate(zip(ncc, qualities, strict=True))
        if own is not None and one.reliable is not False and own < best - MAX_NCC_BELOW_OTHERS
    ]
