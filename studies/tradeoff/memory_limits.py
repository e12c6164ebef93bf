"""g3r-infer below limits of memory: the peak of its process, and what it costs in seconds and decibels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from g3r.bench.command_run import run_infer
from g3r.bench.scores import quality_of_folder
from g3r.errors import InputError
from g3r.evaluation.case import SimulatedCase
from studies.tables import table

SHARES = (1.0, 0.9, 0.8, 0.7)
"""Limits, as shares of what is stated without one."""

GB = 1e9


def limited_rows(
    case: SimulatedCase, name: str, arguments: Sequence[str], output: Path, shares: Sequence[float] = SHARES
) -> list[dict[str, Any]]:
    """A row without a limit, and one for each limit.

    Args:
        case: to be scored against.
        name: of the rows.
        arguments: of g3r-infer.
        output: its folder.
        shares: see `SHARES`.
    """
    first = _row(case, name, arguments, output, None)
    limits = [round(share * first["stated_bytes"]) for share in shares]
    return [first, *[_row(case, name, arguments, output, limit) for limit in limits]]


def _row(case: SimulatedCase, name: str, arguments: Sequence[str], output: Path, limit: int | None) -> dict[str, Any]:
    row: dict[str, Any] = {"name": name, "limit_bytes": limit}
    try:
        run = run_infer([*arguments, *([] if limit is None else ["--max-memory", str(limit)])], output)
    except InputError as error:
        return row | {"refused": str(error)}
    said = run.record.memory
    assert said is not None
    return row | {
        "stated_bytes": said.stated_bytes,
        "measured_bytes": run.peak_bytes,
        "changes": said.changes,
        "seconds": round(run.seconds, 1),
        "cpu_seconds": round(run.cpu_seconds, 1),
        "psnr_db": quality_of_folder(case, output).psnr_db,
    }


def is_kept(row: dict[str, Any]) -> bool:
    """Whether a run stayed below its limit, or was refused."""
    limit = row["limit_bytes"]
    return limit is None or "refused" in row or row["measured_bytes"] <= limit


def limits_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows in Markdown."""

    def given_up(row: dict[str, Any]) -> str:
        if "refused" in row:
            return str(row["refused"]).split(";")[0]
        return "; ".join(change.removeprefix("memory limit: ") for change in row["changes"]) or "nothing"

    def gigabytes(row: dict[str, Any], key: str, otherwise: str) -> str:
        return f"{row[key] / GB:.2f} GB" if row.get(key) is not None else otherwise

    columns: dict[str, Any] = {
        "run": "{name}",
        "limit": lambda row: gigabytes(row, "limit_bytes", "none"),
        "stated": lambda row: gigabytes(row, "stated_bytes", "refused"),
        "measured": lambda row: gigabytes(row, "measured_bytes", ""),
        "CPU seconds": "{cpu_seconds:.0f}",
        "PSNR, dB": "{psnr_db:.2f}",
        "given up": given_up,
    }
    return table(rows, columns)
