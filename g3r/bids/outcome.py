"""What became of a session: what its record says, or why it failed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from g3r.bids.dataset import Session
from g3r.bids.derivative import record_path
from g3r.bids.description import LOGS, as_json, read_object
from g3r.errors import InputError
from g3r.run.atomic_file import write_text

FAILED, NOT_RUN = "failed", "not run"
DO_NOT_USE, CHECK, TRUSTED = "do not use", "check", "trusted"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A row of participants_g3r.tsv.

    Attributes:
        session: of the data set.
        verdict: one of the words above.
        seconds: of the run.
        n_stacks, n_slices, n_used: stacks, slices in them, and slices of at least half the full weight.
        unseen_share: of the brain.
        warnings: of the run.
        reason: why it failed.
    """

    session: Session
    verdict: str
    seconds: float | None = None
    n_stacks: int | None = None
    n_slices: int | None = None
    n_used: int | None = None
    unseen_share: float | None = None
    warnings: tuple[str, ...] = ()
    reason: str | None = None


def log_path(session: Session, out_dir: Path) -> Path:
    """What its last run said."""
    return out_dir / LOGS / f"{_plain(session)}.log"


def failure_path(session: Session, out_dir: Path) -> Path:
    """Why its last run failed; absent where it did not."""
    return out_dir / LOGS / f"{_plain(session)}.failure.json"


def _plain(session: Session) -> str:
    """A name that readers of BIDS do not take for a file of the session: who failed is not in the data set."""
    return f"g3r-{session.stem.replace('_', '-')}"


def write_failure(session: Session, out_dir: Path, reason: str, seconds: float | None) -> None:
    """Keep why a run failed.

    Args:
        session: that failed.
        out_dir: the derivative data set.
        reason: one line.
        seconds: that it took; None where nobody could tell.

    Raises:
        OSError: it cannot be written.
    """
    path = failure_path(session, out_dir)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, as_json({"reason": reason, "seconds": None if seconds is None else round(seconds, 1)}))


def outcome_of(session: Session, out_dir: Path) -> Outcome:
    """What became of a session by what lies in the derivative data set."""
    failure, record = failure_path(session, out_dir), record_path(session, out_dir)
    try:
        if failure.exists():
            said = read_object(failure)
            return Outcome(
                session=session, verdict=FAILED, seconds=said.get("seconds"), reason=str(said.get("reason", ""))
            )
        if record.exists():
            return _of_record(session, read_object(record))
    except (InputError, AttributeError, TypeError) as error:  # somebody changed the file
        return Outcome(session=session, verdict=FAILED, reason=f"{error}; run it again with --force")
    return Outcome(session=session, verdict=NOT_RUN)


def _of_record(session: Session, record: dict[str, Any]) -> Outcome:
    stacks = record.get("stacks") or []
    n_slices = sum(one.get("n_slices", 0) for one in stacks)
    unseen = record.get("unseen") or {}
    return Outcome(
        session=session,
        verdict=_verdict(record),
        seconds=round(sum((record.get("seconds") or {}).values()), 1),
        n_stacks=len(stacks),
        n_slices=n_slices,
        n_used=n_slices - sum(one.get("n_downweighted_slices", 0) for one in stacks),
        unseen_share=unseen.get("share"),
        warnings=tuple(map(str, record.get("warnings") or [])),
    )


def _verdict(record: dict[str, Any]) -> str:
    """In words: unreliable poses or too much unseen brain, anything to look at, or nothing."""
    reliable = (record.get("registration") or {}).get("reliable")
    if reliable is False or not (record.get("unseen") or {}).get("usable", True):
        return DO_NOT_USE
    found_masks = any(one.get("mask_from") != "file" for one in record.get("stacks") or [])
    return TRUSTED if reliable and not record.get("warnings") and not found_masks else CHECK
