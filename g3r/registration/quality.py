"""Which stacks are reliably registered, and warnings about those that are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from g3r.acquisition.area_profile import head_volume_mm3
from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack
from g3r.registration.estimate import Registration
from g3r.registration.open_strain import crossing_deg
from g3r.registration.thresholds import (
    DOWNWEIGHTED_BELOW,
    IN_PLACE_NCC,
    IN_PLACE_SHARE,
    LEEWAY,
    MAX_DOWNWEIGHTED_SHARE,
    MIN_CROSSING_DEG,
    MIN_HELD_OUT,
    MIN_NCC,
    MIN_OVERLAP_CORRELATION,
    MIN_OVERLAP_SHARE,
    MIRRORED_BELOW,
)

PARALLEL = "all stacks: their slices are nearly parallel in the head"
"""How the warning about it begins."""


@dataclass(frozen=True)
class StackQuality:
    """How well the slices of one stack are registered.

    Args:
        reliable: whether every figure is in the range of registered stacks; None for a single stack, which
            nothing checks.
        held_out_correlation: with a volume of the other stacks; None for a single stack.
        median_slice_ncc: of its slices with the volume of all; None without slices.
        downweighted_share: share of slices with a weight below one half.
        n_missing: slices that are missing between others.
        longest_gap_mm: the longest span without a slice between others.
        is_cut: whether the field of view cut the head.
        overlap_share: share of its pixels that other stacks saw; None for a single stack, and where no stack
            lacks slices.
        overlap_correlation: with the other stacks over those pixels.
        handedness: whether it shows the asymmetry of the head as the others do (`registration.handedness`); None where
            that was not asked for or cannot be said.
    """

    reliable: bool | None
    held_out_correlation: float | None
    median_slice_ncc: float | None
    downweighted_share: float
    n_missing: int = 0
    longest_gap_mm: float = 0.0
    is_cut: bool = False
    overlap_share: float | None = None
    overlap_correlation: float | None = None
    handedness: float | None = None

    def record(self) -> dict[str, Any]:
        """For run.json."""
        return asdict(self)


def unknown_orientation_note(slices: Slices) -> str:
    """Why a volume stays in scanner space though the standard orientation was asked for."""
    return (
        "standard orientation unknown, the volume stays in scanner space: no atlas template fits the "
        f"{head_volume_mm3(slices) / 1000:.0f} ml that are masked; check the masks"
    )


def stack_qualities(registration: Registration, n_stacks: int) -> list[StackQuality]:
    """The quality of each given stack, in their order; `n_stacks` counts those without a usable slice, too."""
    found = []
    present = np.unique(registration.slices.stack_id).tolist()
    for n in range(n_stacks):
        of_stack = registration.slices.stack_id == n
        if n not in present:
            found.append(StackQuality(False, None, None, 0.0))
            continue
        held_out = None if registration.held_out is None else registration.held_out[present.index(n)]
        ncc = float(np.median(registration.ncc[of_stack]))
        downweighted = float((registration.weight[of_stack] < DOWNWEIGHTED_BELOW).mean())
        share = correlation = None
        if registration.overlap is not None:
            place = present.index(n)
            share = registration.overlap.stack_share[place]
            correlation = registration.overlap.correlation[place]
        missing = {}
        if registration.profiles:
            profile = registration.profiles[present.index(n)]
            missing = {
                "n_missing": profile.n_inside,
                "longest_gap_mm": profile.longest_gap_mm,
                "is_cut": profile.is_cut,
            }
        one = StackQuality(
            reliable=None,
            held_out_correlation=held_out,
            median_slice_ncc=ncc,
            downweighted_share=downweighted,
            overlap_share=share,
            overlap_correlation=correlation,
            handedness=None if registration.handedness is None else registration.handedness[present.index(n)],
            **missing,
        )
        found.append(one if held_out is None else replace(one, reliable=not (shortfalls(one) or is_mirrored(one))))
    return found


def is_mirrored(one: StackQuality) -> bool:
    """Whether the stack seems to be a mirror image of what the others show."""
    return one.handedness is not None and one.handedness < MIRRORED_BELOW


def shortfalls(one: StackQuality) -> list[str]:
    """What is worse of a stack than of registered ones, each with what is good; empty where nothing is."""
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
    # the template that stood for what others did not see agrees with any head
    if one.overlap_share is not None and one.overlap_share < MIN_OVERLAP_SHARE:
        found.append(f"others saw {100 * one.overlap_share:.3g}% of it; good is {MIN_OVERLAP_SHARE:.0%} and above")
    if one.overlap_correlation is not None and one.overlap_correlation < least_overlap:
        good = f"good is {MIN_OVERLAP_CORRELATION:g} and above"
        found.append(f"agreement {one.overlap_correlation:.3g} where others saw it; {good}")
    return found


def _in_place(one: StackQuality) -> bool:
    """Whether slices fit a volume that others made, too, as only those of stacks in place do."""
    seen_by_others = one.overlap_share is None or one.overlap_share >= IN_PLACE_SHARE
    return one.median_slice_ncc is not None and one.median_slice_ncc >= IN_PLACE_NCC and seen_by_others


def pose_warnings(registration: Registration, qualities: Sequence[StackQuality], stacks: Sequence[Stack]) -> list[str]:
    """A line for each stack that is not reliable.

    Args:
        registration: of the stacks.
        qualities: of each stack.
        stacks: as given, for their names.
    """
    lines = []
    for stack, one in zip(stacks, qualities, strict=True):
        if one.median_slice_ncc is None:
            lines.append(f"{stack.name}: no slice with enough masked pixels; the stack was not used")
        elif is_mirrored(one) and not shortfalls(one):
            lines.append(
                f"{stack.name}: probably a mirror image of what the other stacks show (handedness "
                f"{one.handedness:.2f}); do not rely on the volume"
            )
        elif one.reliable is False:
            lines.append(
                f"{stack.name}: registration probably failed (correlation with the other stacks "
                f"{one.held_out_correlation:.2f}, of its slices with the volume {one.median_slice_ncc:.2f}, "
                f"{one.downweighted_share:.0%} of its slices fit badly{_overlap_text(one)}); do not rely on the volume"
            )
        elif one.reliable is None and one.n_missing:
            lines.append(
                f"{stack.name}: {one.n_missing} slices are missing, up to {one.longest_gap_mm:.0f} mm in a row; that "
                "this part of the head is so long is what the header says, no other stack checks it"
            )
        if one.reliable is None and one.is_cut:
            lines.append(f"{stack.name}: the field of view cuts the head; what lies beyond was seen by no stack")
    return lines


def nearly_parallel(angle_deg: float | None) -> bool:
    """Whether stacks cross at so small an angle (`crossing_deg`) that they do not check each other."""
    return angle_deg is not None and angle_deg < MIN_CROSSING_DEG


def parallel_warnings(slices: Slices) -> list[str]:
    """A line where the slices of all stacks are nearly parallel in the head; none where they are not.

    Args:
        slices: of all stacks, in place.
    """
    angle_deg = crossing_deg(slices)
    if angle_deg is None or not nearly_parallel(angle_deg):
        return []
    return [f"{PARALLEL} ({angle_deg:.0f} degrees between them; good is {MIN_CROSSING_DEG:.0f} and above)"]


def _overlap_text(one: StackQuality) -> str:
    if one.overlap_share is None or one.overlap_correlation is None:
        return ""
    return f"; others saw {one.overlap_share:.0%} of it and correlate {one.overlap_correlation:.2f} there"


def registration_reliable(qualities: Sequence[StackQuality]) -> bool | None:
    """Whether all stacks are reliable; None where nothing checks them (a single stack)."""
    if any(one.reliable is False for one in qualities):
        return False
    return True if all(one.reliable for one in qualities) else None


def registration_summary(qualities: Sequence[StackQuality]) -> str:
    """One line about all stacks."""
    if registration_reliable(qualities) is None:
        return "a single stack: no other stack checks its poses"
    n_reliable = sum(bool(one.reliable) for one in qualities)
    figures = ", ".join(
        "none" if one.held_out_correlation is None else f"{one.held_out_correlation:.2f}" for one in qualities
    )
    return f"{n_reliable} of {len(qualities)} stacks are registered; correlation with the others: {figures}"
