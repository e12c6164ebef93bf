"""Outcome of a run on stacks with faults, and how often its verdict was right."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from g3r.errors import G3RError
from g3r.evaluation.case import SimulatedCase
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from g3r.report.verdict import verdict_of
from g3r.report.verdict_messages import DO_NOT_USE, USE
from studies.harness import Row
from studies.runs import BAD_OFF_SHARE, aligned, off_share

BAD_PSNR_DB = 20.0
"""A result is bad if its PSNR is lower than this, or if more than `BAD_OFF_SHARE` of the brain in its slices is
misplaced."""

TRUE, FALSE = "true", "false alarm"
"""Kinds of a warning: TRUE for one about a bad or incomplete result or an existing fault, FALSE for any other."""


def outcome(case: SimulatedCase, options: argparse.Namespace) -> Row:
    """Reconstruct a subject: errors, verdict, and whether the result is bad. A refusal is bad and has only its reason.

    Args:
        case: the subject, with the true poses of the slices that have one.
        options: of the command; preset and prior are used.
    """
    try:
        result = GaussianReconstructor(options.ckpt, PRESETS[options.preset]).reconstruct(case.stacks)
    except G3RError as refusal:
        return {"word": "refused", "reason": str(refusal), "bad": True}
    error, verdict = case.pose_error(result.slices), verdict_of(result.record)
    psnr_db = aligned(case, result.volume, result.grid, error.common).scores.psnr_db
    off = off_share(error.per_slice_mm, result.slices, result.weight)
    moves_mm = [stack.quality.median_move_mm or 0.0 for stack in result.record.stacks if stack.quality]
    return {
        "psnr_db": round(psnr_db, 3),
        "median_mm": round(error.median_mm, 4),
        "off_share": round(off, 4),
        "median_move_mm": round(max(moves_mm), 2),
        "word": verdict.word,
        "reason": verdict.line(),
        "left_out": [stack.name for stack in result.record.stacks if stack.quality and stack.quality.left_out],
        "bad": off > BAD_OFF_SHARE or psnr_db < BAD_PSNR_DB,
    }


def verdicts(rows: Sequence[Row], warning: Callable[[Row], str]) -> str:
    """Number of each verdict for bad and for good results, in words.

    Args:
        rows: of `outcome`.
        warning: `TRUE` or `FALSE` for the warning of a row, empty without a warning.
    """
    bad, good = [row for row in rows if row["bad"]], [row for row in rows if not row["bad"]]
    return (
        f"Of {len(bad)} bad ones the verdict was *do not use*, or a refusal, in {count(bad, is_refused)}, *check* in "
        f"{count(bad, is_check)} and *use* in {count(bad, is_use)}. Of {len(good)} good ones it was *use* in "
        f"{count(good, is_use)}, *check* in {count(good, is_check)} and *do not use* in {count(good, is_refused)}; in "
        f"{count(good, says_unseen)} of these because a part of the brain was not seen. Of the warnings about good "
        f"ones {count(good, lambda row: warning(row) == TRUE)} name what is wrong with the stacks, "
        f"{count(good, lambda row: warning(row) == FALSE)} are false alarms."
    )


def is_use(row: Row) -> bool:
    """Whether the verdict is *use*."""
    return row["word"] == USE


def is_refused(row: Row) -> bool:
    """Whether it is *do not use*, or the stacks were refused."""
    return row["word"] in (DO_NOT_USE, "refused")


def is_check(row: Row) -> bool:
    """Whether it is *check*."""
    return not is_use(row) and not is_refused(row)


def lacks_a_stack(row: Row) -> bool:
    """Whether a given stack was left out of the volume."""
    return bool(row.get("left_out"))


def says_unseen(row: Row) -> bool:
    """Whether the verdict says that the volume is incomplete, which neither pose errors nor PSNR show."""
    return not is_use(row) and "not seen by any slice" in row["reason"]


def count(rows: Sequence[Row], holds: Callable[[Row], bool]) -> int:
    """Number of rows for which `holds` is true."""
    return sum(map(holds, rows))
