"""`python -m studies.tradeoff.time_budgets`: whether --time-budget is kept, and the gain by a longer budget."""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from g3r.bench.command_run import infer_arguments, run_infer
from g3r.bench.scores import quality_of_folder
from g3r.evaluation.case import load_case
from studies.harness import Record, Row, Study, Task
from studies.subjects import THICKNESS_MM, chosen_folders
from studies.tables import marked, table

BUDGETS_S = (6.0, 8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0, 40.0, 60.0, 120.0)

MORE_SHARE, MORE_S = 0.1, 2.0
"""Accepted excess over a budget: a share of it, and seconds."""

MAX_LOSS_DB = 0.1
"""Accepted loss with a longer budget compared with a shorter one."""


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per budget, case by case."""
    for folder in chosen_folders(options.folders):
        for budget_s in sorted(options.budgets):
            thickness = options.thickness or THICKNESS_MM.get(folder.name)
            yield Task(f"{folder.name}, {budget_s:g} s", measure, (folder, budget_s, thickness, options.output / "out"))


@functools.lru_cache(maxsize=1)
def compiled(arguments: tuple[str, ...], output: Path) -> None:
    """Run once before the measurement, so that the kernels are compiled."""
    run_infer(arguments, output)


def _spin() -> None:
    while True:
        pass


@contextmanager
def one_core_busy() -> Iterator[None]:
    """Keep one core busy with another process."""
    other = multiprocessing.get_context("spawn").Process(target=_spin, daemon=True)
    other.start()
    try:
        yield
    finally:
        other.kill()
        other.join()


def measure(folder: Path, budget_s: float, thickness_mm: float | None, output: Path) -> Row:
    """Measure two runs of the command under a time budget, alone and beside a process that takes one core.

    Args:
        folder: of the case.
        budget_s: the time budget in seconds.
        thickness_mm: of the slices; None if the case records it.
        output: folder for the results.
    """
    case = load_case(folder, thickness_mm)
    plain = infer_arguments(case, "preview", output)
    compiled(tuple(infer_arguments(case, "balanced", output)), output)  # balanced uses the kernels of all stages
    at = plain.index("--preset")
    arguments = [*plain[:at], "--time-budget", f"{budget_s:g}", *plain[at + 2 :]]
    with one_core_busy():
        busy_s = run_infer(arguments, output).seconds
    run = run_infer(arguments, output)
    chosen = run.record.time_budget
    assert chosen is not None
    return {
        "case": case.name,
        "budget_s": budget_s,
        "seconds": round(run.seconds, 1),
        "busy_seconds": round(busy_s, 1),
        "registration": chosen.registration,
        "fit": chosen.fit,
        "n_steps": len(run.record.loss["fit to slices"]),
        "n_gaussians": run.record.n_gaussians,
        **quality_of_folder(case, output).record(),
    }


def tables(record: Record) -> dict[str, str]:
    """A row for each budget; (!) marks one that was exceeded, or a volume worse than a shorter one's."""
    rows = sorted(record["rows"].values(), key=lambda row: (row["case"], row["budget_s"]))

    def took(row: Row, name: str) -> str:
        return marked(f"{row[name]:.1f}", row[name] <= (1 + MORE_SHARE) * row["budget_s"] + MORE_S)

    def psnr(row: Row) -> str:
        shorter = [one["psnr_db"] for one in rows if one["case"] == row["case"] and one["budget_s"] < row["budget_s"]]
        return marked(f"{row['psnr_db']:.2f}", row["psnr_db"] >= max(shorter, default=0.0) - MAX_LOSS_DB)

    columns: dict[str, Any] = {
        "case": "{case}",
        "budget, s": "{budget_s:g}",
        "took, s": lambda row: took(row, "seconds"),
        "with one core busy, s": lambda row: took(row, "busy_seconds"),
        "registration as in": "{registration}",
        "Gaussians as in": "{fit}",
        "steps": "{n_steps}",
        "Gaussians": "{n_gaussians:,}",
        "PSNR, dB": psnr,
    }
    return {
        "time-budgets": f"{table(rows, columns)}\n\nWhole command, one run each, kernels compiled; the rest of a row "
        f"is of the run that had all cores. (!): more than "
        f"{MORE_SHARE:.0%} and {MORE_S:g} s over the budget, or more than {MAX_LOSS_DB:g} dB below a shorter one."
    }


STUDY = Study(
    name="tradeoff.time_budgets",
    about="Run g3r-infer with rising time budgets, as a user would.",
    document="tradeoff.md",
    shared=("folders",),
    options={
        "--thickness": {"type": float, "metavar": "MM", "help": "of slices (None: simulation.json)"},
        "--budgets": {"type": float, "nargs": "+", "metavar": "S", "default": BUDGETS_S, "help": "seconds"},
    },
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
