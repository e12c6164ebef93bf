"""participants_g3r.tsv: one row per session of the data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from g3r.bids.description import as_json
from g3r.bids.outcome import Outcome
from g3r.run.atomic_file import write_text

TABLE, DICTIONARY = "participants_g3r.tsv", "participants_g3r.json"

COLUMNS = {
    "participant_id": "participant",
    "session_id": "session; n/a where the data set has none",
    "verdict": "use, check (look at the figures) or do not use, as in run.json and on the terminal; failed; not run; "
    "no stack",
    "seconds": "of the run",
    "stacks": "stacks in the volume, without those that were left out",
    "slices_used": "slices of at least half the full weight",
    "slices": "slices that show the brain",
    "unseen_share": "share of the brain that no slice saw, 0 to 1",
    "reasons": "of the verdict, or why it failed",
}


def write_table(outcomes: Sequence[Outcome], out_dir: Path) -> Path:
    """Write the table and the descriptions of its columns; returns the table's path.

    Raises:
        OSError: it cannot be written.
    """
    path = out_dir / TABLE
    rows = ["\t".join(COLUMNS), *("\t".join(_row(one)) for one in outcomes)]
    write_text(path, "\n".join(rows) + "\n")
    write_text(out_dir / DICTIONARY, as_json({name: {"Description": text} for name, text in COLUMNS.items()}))
    return path


def _row(one: Outcome) -> list[str]:
    session = one.session
    cells = [
        f"sub-{session.participant}",
        f"ses-{session.session}" if session.session else None,
        one.verdict,
        one.seconds,
        one.n_stacks,
        one.n_used,
        one.n_slices,
        None if one.unseen_share is None else round(one.unseen_share, 4),
        "; ".join(one.reasons),
    ]
    return [" ".join(str(cell).split()) if cell not in (None, "") else "n/a" for cell in cells]
