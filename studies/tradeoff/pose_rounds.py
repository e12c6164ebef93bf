"""`python -m studies.tradeoff.pose_rounds`: gain by rounds of poses and volume, on one registration."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import aligned, figures
from studies.subjects import case_folders, read_case
from studies.tables import Cell, table

CASES = ("sta30-none", "sb28-mild-gap", "sta30-moderate", "sb32-moderate", "sta34-single")

ROUNDS = (0, 1, 2)


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case and number of its stacks, which measures all numbers of rounds."""
    for folder in case_folders(options.cases):
        for n_stacks in range(1, len(read_case(folder).stacks) + 1):
            yield Task(f"{folder.name}, {n_stacks}", measure, (folder, n_stacks, options))


def measure(folder: Path, n_stacks: int, options: argparse.Namespace) -> Row:
    """Measure the first stacks of a case with each number of rounds.

    Args:
        folder: of the case.
        n_stacks: number of its stacks to use.
        options: of the command.
    """
    case = read_case(folder, n_stacks)
    registration = GaussianReconstructor(options.ckpt, PRESETS[options.preset]).register_stacks(case.stacks)
    found: Row = {"case": folder.name, "n_stacks": n_stacks, "poses_mm": {}, "volume": {}, "prior": {}, "kept": {}}
    for n in ROUNDS:
        preset = PRESETS[options.preset]
        rounds = replace(preset.pose_rounds, single_stack=n, two_stacks=n, more_stacks=n)
        settings = replace(preset, pose_rounds=rounds)
        result = GaussianReconstructor(options.ckpt, settings).reconstruct(case.stacks, registration)
        error, name = case.pose_error(result.slices), str(n)
        found["poses_mm"][name] = round(error.median_mm, 3)
        found["volume"][name] = figures(aligned(case, result.volume, result.grid, error.common).scores)
        found["prior"][name] = figures(aligned(case, result.prior, result.prior_grid, error.common).scores)
        found["kept"][name] = result.record.pose_rounds.n_kept if result.record.pose_rounds else 0
    return found


def line(key: str, row: Row) -> str:
    """Progress line of a finished case."""
    return f"{key}: " + ", ".join(f"{n} rounds {found['psnr_db']:.2f}" for n, found in row["volume"].items())


def tables(record: Record) -> dict[str, str]:
    """A row per case and number of stacks."""
    columns: dict[str, Cell] = {"case": "{case}", "stacks": "{n_stacks}"}
    for title, name, form in (("volume, dB", "volume", "[psnr_db]:.2f"), ("V_prior, dB", "prior", "[psnr_db]:.2f")):
        columns |= {f"{title}, {n} rounds": f"{{{name}[{n}]{form}}}" for n in ROUNDS}
    columns |= {f"poses, mm, {n} rounds": f"{{poses_mm[{n}]:.2f}}" for n in ROUNDS}
    columns["kept of 2"] = "{kept[2]}"
    # a format would read digits in brackets as a list index
    parts = ("volume", "prior", "poses_mm", "kept")
    rows = [row | {part: _by_number(row[part]) for part in parts} for row in record["rows"].values()]
    return {"pose-rounds": f"Preset `{record['preset']}`, weights {record['weights']}.\n\n{table(rows, columns)}"}


def _by_number(found: Row) -> dict[int, object]:
    return {int(n): value for n, value in found.items()}


STUDY = Study(
    name="tradeoff.pose_rounds",
    about="Reconstruct the cases, with all of their stacks and with fewer, without rounds of poses and volume and with "
    "one and two of them.",
    document="tradeoff.md",
    shared=FITS,
    options={
        "--cases": {"nargs": "+", "metavar": "GLOB", "default": list(CASES), "help": "parts of the names of cases"}
    },
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
