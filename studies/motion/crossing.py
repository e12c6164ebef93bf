"""`python -m studies.motion.crossing`: two stacks at any angle, registered and compared with the truth."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

from data_synth.simulator import StackSettings
from g3r.registration.quality import PARALLEL
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import BAD_OFF_SHARE, OFF_MM, run
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import Cell, details, table

VOLUMES = ("crl-sta/sta26", "spina-bifida/sb28-operated", "crl-sta/sta32")

TILTS_DEG = (0.0, 12.0, 20.0, 28.0, 36.0)
"""Standard deviation, per axis, of the tilt of each stack. Rotation of the head between the stacks adds to it."""

LEVELS = ("mild", "moderate", "severe")

FIRST_SEED = 75_000
"""First seed. `MIN_CROSSING_DEG` was chosen on these subjects; to validate it, use others."""

EDGES_DEG = (0, 15, 30, 45, 91)
"""Limits of the ranges of angles in the table."""


@dataclass(frozen=True, kw_only=True)
class TiltedSubject(SubjectSpec):
    """A subject with two axial stacks that are tilted at random, as their headers say."""

    tilt_deg: float

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Acquisition settings of its stacks."""
        axial = super().acquisition(1)[0]
        return [replace(axial, oblique_deg=self.tilt_deg)] * 2


def specs() -> list[TiltedSubject]:
    """Every tilt of every head at every level of motion, each with its own seed."""
    chosen: list[TiltedSubject] = []
    for level in LEVELS:
        for tilt_deg in TILTS_DEG:
            for volume in VOLUMES:
                seed = FIRST_SEED + len(chosen)
                name = f"crossing-{seed}"
                chosen.append(TiltedSubject(name=name, volume=volume, motion=level, seed=seed, tilt_deg=tilt_deg))
    return chosen


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per subject."""
    for spec in specs():
        yield Task(spec.name, measure, (spec, options))


def measure(spec: TiltedSubject, options: argparse.Namespace) -> Row:
    """Register one subject and compare it with the truth."""
    _, row = run(simulated_case(spec, options.cache), options, full=False)
    return {"level": spec.motion, "tilt_deg": spec.tilt_deg, **row}


def line(name: str, row: Row) -> str:
    """Progress line of a finished subject."""
    angle = f"{row['crossing_deg']:.0f} degrees"
    return f"{name}: {angle}, TRE median {row['median_mm']:.2f} mm, off {row['off_share']:.1%}"


def tables(record: Record) -> dict[str, str]:
    """A row for each range of angles, and one for each subject."""
    rows = [{"name": name, **row} for name, row in record["rows"].items()]
    ranges = [
        {"low": low, "high": high, "of": [row for row in rows if low <= row["crossing_deg"] < high]}
        for low, high in pairwise(EDGES_DEG)
    ]
    text = (
        f"Preset `{record['preset']}`, registration alone. TRE in mm; bad: more than {BAD_OFF_SHARE:.0%} of the brain "
        f"in slices that are used is more than {OFF_MM:g} mm off."
    )
    summary = table([one for one in ranges if one["of"]], SUMMARY)
    return {"crossing": "\n\n".join([text, summary, details("Every subject", table(rows, EACH))])}


def _is_bad(row: Row) -> bool:
    return bool(row["off_share"] > BAD_OFF_SHARE)


def _otherwise_warned(row: Row) -> bool:
    """Whether there is a warning about anything but the angle."""
    return any(not line.startswith(PARALLEL) for line in row["warnings"])


def _medians(rows: Sequence[Row]) -> list[float]:
    return [row["median_mm"] for row in rows]


SUMMARY: dict[str, Cell] = {
    "crossing angle, degrees": lambda row: f"{row['low']} to {min(row['high'], 90)}",
    "pairs": lambda row: len(row["of"]),
    "median of medians": lambda row: f"{median(_medians(row['of'])):.2f}",
    "worst median": lambda row: f"{max(_medians(row['of'])):.2f}",
    "bad": lambda row: sum(map(_is_bad, row["of"])),
    "bad, warned": lambda row: sum(one["warned"] for one in row["of"] if _is_bad(one)),
    "bad, warned but for the angle": lambda row: sum(_otherwise_warned(one) for one in row["of"] if _is_bad(one)),
}

EACH: dict[str, Cell] = {
    "subject": "{name}",
    "motion": "{level}",
    "tilt": "{tilt_deg:.0f}",
    "crossing angle": "{crossing_deg:.0f}",
    "median": "{median_mm:.2f}",
    "p90": "{p90_mm:.2f}",
    "used, off": "{off_share:.1%}",
    "warned": lambda row: "yes" if row["warned"] else "-",
}

STUDY = Study(
    name="motion.crossing",
    about="Register two stacks at any angle to each other, and measure how far their slices are off.",
    document="motion.md",
    shared=(*FITS, "--jobs", "--cache"),
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
