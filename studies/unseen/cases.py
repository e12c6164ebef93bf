"""`python -m studies.unseen.cases`: cases of the test data with slices removed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

from studies.harness import FITS, Record, Row, Study, Task
from studies.holes import Hole, with_holes
from studies.subjects import data_folder, read_case
from studies.tables import table
from studies.unseen.measurement import EACH, line, measured


@dataclass(frozen=True, kw_only=True)
class HoledCase:
    """A case of the test data, the number of its stacks to use, and their holes."""

    case: str
    n_stacks: int
    holes: tuple[Hole, ...]


CASES = {
    "one stack, five slices": HoledCase(case="sta34-single", n_stacks=1, holes=(Hole(0, 0.44, 0.565),)),
    "one stack with gaps, one slice": HoledCase(case="sb28-mild-gap", n_stacks=1, holes=(Hole(0, 0.8, 0.9),)),
    "two halves": HoledCase(case="sb32-moderate", n_stacks=2, holes=(Hole(0, 0.55), Hole(1, 0.0, 0.45))),
    "three stacks, middle thirds": HoledCase(
        case="sta30-moderate", n_stacks=3, holes=(Hole(0, 0.3, 0.6), Hole(1, 0.3, 0.6), Hole(2, 0.35, 0.65))
    ),
}
"""Cases, all of which were looked at while settings were chosen."""


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case."""
    for name, chosen in CASES.items():
        yield Task(name, measure, (chosen, options))


def measure(chosen: HoledCase, options: argparse.Namespace) -> Row:
    """Reconstruct one case and score its seen and unseen brain.

    Args:
        chosen: with its holes.
        options: of the command.
    """
    case = read_case(data_folder("cases") / chosen.case, chosen.n_stacks)
    return measured(replace(case, stacks=with_holes(case.stacks, chosen.holes)), options, true_poses=True)


def tables(record: Record) -> dict[str, str]:
    """A row per case; the difference to the last column is the loss by wrong poses."""
    named = ({"name": f"{CASES[name].case}: {name}", **row} for name, row in record["rows"].items())
    return {"unseen-cases": table(named, {**EACH, "whole dB, true poses": "{at_true_poses[whole]:.2f}"})}


STUDY = Study(
    name="unseen.cases",
    about="Empty slices of cases of the test data; measure poses, brain volume and what fills the hole.",
    document="unseen.md",
    shared=FITS,
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
