"""`python -m studies.prior.cases`: reconstruction with and without the prior on the cases of the test data."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from studies.harness import FITS, Record, Row, Study, Task
from studies.prior.ablation import BASELINE, VARIANTS, line, measure
from studies.subjects import case_folders, read_case
from studies.tables import Cell, marked, table

MAX_LOSS_DB = 0.1
"""Largest accepted loss by the prior from several stacks."""

PRODUCT = VARIANTS[-1]


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case."""
    for folder in case_folders(options.cases):
        yield Task(folder.name, measure_case, (folder, options))


def measure_case(folder: Path, options: argparse.Namespace) -> Row:
    """Measure every variant on one case with all its stacks."""
    case = read_case(folder)
    return {"n_stacks": len(case.stacks), **measure(case, options)}


def gain(row: Row) -> str:
    """Gain by the prior; a loss is marked (!)."""
    value = row["scores"][PRODUCT]["psnr_db"] - row["scores"][BASELINE]["psnr_db"]
    return marked(f"{value:+.2f}", value >= -MAX_LOSS_DB)


def tables(record: Record) -> dict[str, str]:
    """A row per case: dB of every variant, gain by the prior, median TRE."""
    columns: dict[str, Cell] = {
        "case": "{case}",
        "stacks": "{n_stacks}",
        **{name: f"{{scores[{name}][psnr_db]:.2f}}" for name in VARIANTS},
        "prior brings": gain,
        "SSIM": f"{{scores[{PRODUCT}][ssim]:.3f}}",
        "TRE, mm": f"{{median_mm[{PRODUCT}]:.2f}}",
    }
    text = table(({"case": case, **row} for case, row in record["rows"].items()), columns)
    return {
        "cases": f"dB; preset `{record['preset']}`, weights {record['weights']}. (!) marks a loss of more than "
        f"{MAX_LOSS_DB:g} dB.\n\n{text}"
    }


STUDY = Study(
    name="prior.cases",
    about="Every variant of studies.prior.ablation on the cases, with all their stacks.",
    document="prior.md",
    shared=(*FITS, "--cases"),
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
