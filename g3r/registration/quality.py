"""Reliability of the registration of each stack, and warnings about stacks that are not reliable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from g3r.acquisition.area_profile import head_volume_mm3
from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack
from g3r.registration.estimate import Registration
from g3r.registration.open_strain import crossing_deg
from g3r.registration.stack_quality import StackQuality, is_mirrored, rounded_down, shortfalls
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW, MIN_CROSSING_DEG

PARALLEL = "all stacks: their slices are nearly parallel in the head"
"""Start of the warning about nearly parallel stacks."""

LEFT_OUT = "left out of the volume"
NO_SLICE = "no slice with enough masked pixels"
PROBABLY_MIRRORED = "probably a mirror image of"
FAILED = "registration probably failed"

JUDGED = (LEFT_OUT, NO_SLICE, PROBABLY_MIRRORED, FAILED)
"""Starts, after the stack's name, of warnings about a quality that the verdict has a message of its own for."""

WITHOUT_SLICES = StackQuality(reliable=False, held_out_correlation=None, median_slice_ncc=None, downweighted_share=0.0)
"""Quality of a stack without slices."""


def unknown_orientation_note(slices: Slices) -> str:
    """Why a volume stays in scanner space though the standard orientation was asked for."""
    return (
        "standard orientation unknown, the volume stays in scanner space: no atlas template fits the "
        f"{head_volume_mm3(slices) / 1000:.0f} ml that are masked; check the masks"
    )


def stack_qualities(registration: Registration, n_stacks: int) -> list[StackQuality]:
    """The quality of each given stack, in their order; `n_stacks` counts stacks without slices, too."""
    found, left_out = [], dict(registration.left_out)
    present = np.unique(registration.slices.stack_id).tolist()
    for n in range(n_stacks):
        of_stack = registration.slices.stack_id == n
        if n not in present:
            found.append(left_out.get(n, WITHOUT_SLICES))
            continue
        place = present.index(n)
        held_out = None if registration.held_out is None else registration.held_out[place]
        ncc = float(np.median(registration.ncc[of_stack]))
        downweighted = float((registration.weight[of_stack] < DOWNWEIGHTED_BELOW).mean())
        share = correlation = None
        if registration.overlap is not None:
            share = registration.overlap.stack_share[place]
            correlation = registration.overlap.correlation[place]
        missing = {}
        if registration.profiles:
            profile = registration.profiles[place]
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
            median_move_mm=registration.median_move_mm[place],
            overlap_share=share,
            overlap_correlation=correlation,
            handedness=None if registration.handedness is None else registration.handedness[place],
            **missing,
        )
        fails = bool(shortfalls(one)) or is_mirrored(one)
        found.append(one if held_out is None else replace(one, reliable=not fails))
    if registration.misfit_without is not None and all(found[n].reliable for n in present):
        # a failed stack is known to be wrong, and while it stays, others may gain without a sound one
        for n, left in zip(present, registration.misfit_without, strict=True):
            one = replace(found[n], misfit_without=left)
            found[n] = replace(one, reliable=not shortfalls(one))
    return found


def pose_warnings(qualities: Sequence[StackQuality], stacks: Sequence[Stack]) -> list[str]:
    """Warnings about stacks, a line each, such as for a stack that is not reliable.

    Args:
        qualities: of each stack.
        stacks: as given, for their names.
    """
    lines = []
    for stack, one in zip(stacks, qualities, strict=True):
        if one.median_slice_ncc is None:
            lines.append(f"{stack.name}: {NO_SLICE}; the stack was not used")
        elif one.left_out:
            # a stack that merely does not fit does no harm once it is left out: `left_out_notes`
            lines += [f"{stack.name}: {LEFT_OUT}, {misfit(one)}"] if is_mirrored(one) else []
        elif is_mirrored(one) and not shortfalls(one):
            lines.append(
                f"{stack.name}: {PROBABLY_MIRRORED} what the other stacks show (handedness "
                f"{rounded_down(one.handedness)}); do not rely on the volume"
            )
        elif one.reliable is False:
            lines.append(
                f"{stack.name}: {FAILED} (correlation with the other stacks "
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


def left_out_notes(qualities: Sequence[StackQuality], stacks: Sequence[Stack]) -> list[str]:
    """A line for each stack that was left out, except mirror images, which get a warning.

    Args:
        qualities: of each stack.
        stacks: as given, for their names.
    """
    return [
        f"{stack.name}: {LEFT_OUT}, {misfit(one)}"
        for stack, one in zip(stacks, qualities, strict=True)
        if one.left_out and not is_mirrored(one)
    ]


def misfit(one: StackQuality) -> str:
    """Why a stack was left out."""
    if is_mirrored(one):
        said = rounded_down(one.handedness)
        return f"it is probably a mirror image of what the other stacks show (handedness {said})"
    why = "; ".join(shortfalls(one)) or f"its slices agree with the volume by {one.median_slice_ncc:.2f}, others better"
    return f"it does not fit the other stacks ({why})"


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
    """Whether all stacks in the volume are reliable; None where nothing checks them (a single stack)."""
    used = [one for one in qualities if not one.left_out]
    if any(one.reliable is False for one in used):
        return False
    return True if all(one.reliable for one in used) else None


def registration_summary(qualities: Sequence[StackQuality]) -> str:
    """One line about all stacks."""
    if registration_reliable(qualities) is None:
        return "a single stack: no other stack checks its poses"
    n_reliable = sum(bool(one.reliable) for one in qualities)
    figures = ", ".join(
        "none" if one.held_out_correlation is None else f"{one.held_out_correlation:.2f}" for one in qualities
    )
    n_left_out = sum(one.left_out for one in qualities)
    left_out = f"; {n_left_out} left out" if n_left_out else ""
    return f"{n_reliable} of {len(qualities)} stacks are registered{left_out}; correlation with the others: {figures}"
