"""The rows of the page's table of stacks."""

from __future__ import annotations

from dataclasses import dataclass

from g3r.output.record import RunRecord
from g3r.output.stack_record import StackRecord
from g3r.registration.thresholds import MIN_HELD_OUT, RETRY_BELOW_CORRELATION

THICKNESS_FROM = {
    "option": "given by the user",
    "sidecar": "from the scanner's sidecar",
    "header": "from the headers of the slices",
    "spacing": "assumed: the distance of slices",
}
MASK_FROM = {
    "file": "given by the user",
    "empty background": "the part that is not zero",
    "whole image": "none: the whole image",
    "automatic": "found by the network",
    "command": "found by the user's command",
}
LEAST_MOVE_MM = 0.1
"""Median movements below this are not told."""

SCALE_FROM = 0.3
"""Agreement at the left end of the scale; the right end is 1."""


@dataclass(frozen=True, kw_only=True)
class StackRow:
    """One stack in words.

    Attributes:
        name: name of the file.
        thickness, thickness_from: slice thickness and its source.
        thickness_assumed: whether the thickness is unknown and assumed equal to the slice spacing.
        spacing: distances of pixels and of slices.
        mask, mask_from: volume of the mask and its source.
        used, n_slices: slices of at least half the full weight, and all slices.
        agreement: correlation with the other stacks, as text.
        place: position of the agreement on the scale, 0 to 1; None if nothing was compared.
        judgement: "good", "doubtful", "bad", "left out" or "not checked".
        motion: how the head moved while it was acquired, in words; empty if it did not.
    """

    name: str
    thickness: str
    thickness_from: str
    thickness_assumed: bool
    spacing: str
    mask: str
    mask_from: str
    used: int
    n_slices: int
    agreement: str
    place: float | None
    judgement: str
    motion: str


def scale_ends() -> tuple[float, float]:
    """Positions on the scale, 0 to 1, at which "bad" ends and "good" begins."""
    return _place(MIN_HELD_OUT), _place(RETRY_BELOW_CORRELATION)


def stack_rows(record: RunRecord) -> list[StackRow]:
    """A row for each stack of a run."""
    return [_row(stack) for stack in record.stacks]


def _row(stack: StackRecord) -> StackRow:
    quality = stack.quality
    found = quality.held_out_correlation if quality else None
    return StackRow(
        name=stack.name,
        thickness=f"{stack.thickness_mm:g} mm",
        thickness_from=THICKNESS_FROM[stack.thickness_from],
        thickness_assumed=stack.thickness_from == "spacing",
        spacing=" x ".join(f"{x:.3g}" for x in stack.spacing_mm) + " mm" if stack.spacing_mm else "",
        mask=f"{stack.mask_ml:.0f} ml" if stack.mask_ml else "",
        mask_from=MASK_FROM[stack.mask_from],
        used=stack.n_slices - stack.n_downweighted_slices,
        n_slices=stack.n_slices,
        agreement="-" if found is None else f"{found:.2f}",
        place=None if found is None else _place(found),
        judgement=_judgement(stack, found),
        motion=_motion((stack.n_segments or 1) - 1, quality.median_move_mm if quality else None),
    )


def _motion(n_jumps: int, median_mm: float | None) -> str:
    said = []
    if n_jumps:
        said.append("the head jumped once" if n_jumps == 1 else f"the head jumped {n_jumps} times")
    if median_mm is not None and median_mm >= LEAST_MOVE_MM:
        said.append(f"{median_mm:.1f} mm from slice to slice")
    return ", ".join(said)


def _judgement(stack: StackRecord, found: float | None) -> str:
    if stack.quality and stack.quality.left_out:
        return "left out"
    if stack.quality and stack.quality.reliable is False:
        return "bad"
    if found is None:
        return "not checked"
    return "good" if found >= RETRY_BELOW_CORRELATION else "doubtful"


def _place(agreement: float) -> float:
    return round(min(max((agreement - SCALE_FROM) / (1 - SCALE_FROM), 0.0), 1.0), 3)
