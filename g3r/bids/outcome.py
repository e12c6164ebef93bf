"""Outcome of a session: the verdict of its record, or why it failed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from g3r.bids.dataset import Session
from g3r.bids.derivative import record_path
from g3r.bids.description import LOGS, as_json, read_object
from g3r.errors import InputError
from g3r.report.verdict_messages import MILDEST_FIRST
from g3r.run.atomic_file import write_text

FAILED, NOT_RUN, NO_STACK = "failed", "not run", "no stack"
"""Words of a session without a verdict."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A row of participants_g3r.tsv.

    Attributes:
        session: session of the data set.
        verdict: verdict of run.json, or "failed", "not run" or "no stack".
        seconds: duration of the run.
        n_stacks, n_slices, n_used: stacks in the volume, slices of all stacks, and slices of at least half the full
            weight.
        unseen_share: unseen share of the brain.
        reasons: reasons of the verdict or of the failure.
    """

    session: Session
    verdict: str
    seconds: float | None = None
    n_stacks: int | None = None
    n_slices: int | None = None
    n_used: int | None = None
    unseen_share: float | None = None
    reasons: tuple[str, ...] = ()


def log_path(session: Session, out_dir: Path) -> Path:
    """Path of the log of the session's last run."""
    return out_dir / LOGS / f"{_plain(session)}.log"


def failure_path(session: Session, out_dir: Path) -> Path:
    """Path of the reason why the session's last run failed; the file is absent if it did not fail."""
    return out_dir / LOGS / f"{_plain(session)}.failure.json"


def _plain(session: Session) -> str:
    """A name that BIDS readers do not take for a file of the session: failed sessions are not in the data set."""
    return f"g3r-{session.stem.replace('_', '-')}"


def write_failure(session: Session, out_dir: Path, reason: str, seconds: float | None) -> None:
    """Write down why a run failed.

    Args:
        session: the failed session.
        out_dir: the derivative data set.
        reason: one line.
        seconds: its duration; None if unknown.

    Raises:
        OSError: it cannot be written.
    """
    path = failure_path(session, out_dir)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, as_json({"reason": reason, "seconds": None if seconds is None else round(seconds, 1)}))


def outcome_of(session: Session, out_dir: Path) -> Outcome:
    """The outcome of a session, from the files in the derivative data set."""
    failure, record = failure_path(session, out_dir), record_path(session, out_dir)
    if not session.stacks:
        return Outcome(session=session, verdict=NO_STACK, reasons=(f"not read: {', '.join(session.left_out)}",))
    try:
        if failure.exists():
            said = read_object(failure)
            return Outcome(
                session=session, verdict=FAILED, seconds=said.get("seconds"), reasons=(str(said.get("reason", "")),)
            )
        if record.exists():
            return _of_record(session, read_object(record), record.name)
    except (InputError, AttributeError, TypeError) as error:  # the file was edited
        return Outcome(session=session, verdict=FAILED, reasons=(f"{error}; run it again with --force",))
    return Outcome(session=session, verdict=NOT_RUN)


def _of_record(session: Session, record: dict[str, Any], name: str) -> Outcome:
    stacks = record.get("stacks") or []
    n_slices = sum(one.get("n_slices", 0) for one in stacks)
    unseen = record.get("unseen") or {}
    verdict = record.get("verdict")
    if verdict not in MILDEST_FIRST:
        raise InputError(f"{name}: holds no verdict; an earlier version of g3r wrote it")
    return Outcome(
        session=session,
        verdict=verdict,
        seconds=round(sum((record.get("seconds") or {}).values()), 1),
        n_stacks=sum(not (one.get("quality") or {}).get("left_out") for one in stacks),
        n_slices=n_slices,
        n_used=n_slices - sum(one.get("n_downweighted_slices", 0) for one in stacks),
        unseen_share=unseen.get("share"),
        reasons=tuple(map(str, record.get("reasons") or [])),
    )
