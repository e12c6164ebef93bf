"""Results of a cohort: volumes and rows of its table."""

from __future__ import annotations

import csv
from pathlib import Path


def rows(out: Path) -> dict[str, dict[str, str]]:
    """Rows of participants_g3r.tsv by participant."""
    with (out / "participants_g3r.tsv").open() as file:
        return {row["participant_id"]: row for row in csv.DictReader(file, delimiter="\t")}


def volumes(out: Path) -> dict[str, int]:
    """Time of writing of each volume (ns), by name."""
    return {path.name: path.stat().st_mtime_ns for path in out.glob("sub-*/**/*_rec-g3r_T2w.nii.gz")}
