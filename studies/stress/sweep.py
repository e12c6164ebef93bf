"""`python -m studies.stress.sweep`: one fault at a time, and whether the verdict warns about it when it matters."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import mean, median
from typing import Any

import numpy as np

from data_synth.simulator import StackSettings
from studies.harness import FITS, Record, Row, Study, Task
from studies.stress import damage
from studies.stress.damage import Damage
from studies.stress.outcome import (
    FALSE,
    TRUE,
    count,
    is_check,
    is_refused,
    is_use,
    lacks_a_stack,
    outcome,
    says_unseen,
    verdicts,
)
from studies.subjects import SubjectSpec, is_named, simulated_case
from studies.tables import Cell, details, table

VOLUMES = ("crl-sta/sta24", "crl-sta/sta30", "crl-sta/sta34")
"""Weeks that were not used for training."""

FIRST_SEED = 91_000
"""First seed of this study."""

ONE_STACK = "one stack"
"""Name of the faults that concern one stack only."""

LAST = "stack-2.nii.gz"
"""Name of the stack with the fault if it concerns one stack only."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One deviation from three clean stacks with moderate motion.

    Attributes:
        what: name of the deviation.
        level: its level.
        motion: of the head.
        taken: settings of the stacks (`StackSettings`) that differ.
        damage: to the stacks after the simulation.
        fault: words of a verdict that names this fault; such a warning is right even if the volume is good.
    """

    what: str
    level: str
    motion: str = "moderate"
    taken: Mapping[str, Any] = field(default_factory=dict)
    damage: Damage = field(default_factory=damage.nothing)
    fault: str = ""

    @property
    def name(self) -> str:
        """Name of its rows."""
        return f"{self.what}: {self.level}"


def _conditions() -> Iterator[Condition]:
    yield Condition(what="nothing", level="moderate motion, 3 stacks, 0.8 x 0.8 x 2.2 mm")
    for motion in ("none", "mild", "severe"):
        yield Condition(what="motion", level=motion, motion=motion)
    for n in (2, 1):
        alone = "a single stack" if n == 1 else ""
        yield Condition(what="stacks", level=str(n), damage=damage.first_stacks(n), fault=alone)
    for gap_mm in (1.1, 2.2):
        yield Condition(what="gap", level=f"{gap_mm:g} mm", taken={"gap_mm": gap_mm})
    for mm in (3.3, 4.4):
        yield Condition(what="thickness", level=f"{mm:g} mm", taken={"thickness_mm": mm})
    for snr in (10.0, 5.0):
        yield Condition(what="noise", level=f"SNR {snr:g}", taken={"snr": snr})
    for bias in (0.15, 0.3):
        yield Condition(what="bias field", level=f"{bias:g}", taken={"bias": bias})
    yield Condition(what="slices missing", level="one in five", damage=damage.slices_lost(0.2))
    yield Condition(what="slices missing", level="the middle third", damage=damage.span_lost(1 / 3))
    for factor in (0.7, 1.3):
        yield Condition(what="stated thickness", level=f"{factor - 1:+.0%}", damage=damage.stated_thickness(factor))
    for pixels in (-4, -2, -1, 1, 2, 4, 8):
        leave_out = "the mask of" if pixels < 0 else ""
        yield Condition(what="masks", level=f"{pixels:+d} pixels", damage=damage.masks_grown(pixels), fault=leave_out)
    yield Condition(what="images", level="zero beyond their masks", damage=damage.images_cut())
    coarse = {"resolution_mm": 1.2}
    yield Condition(what="images", level="1.2 mm", taken=coarse)
    yield Condition(what="images", level="1.2 to 0.6 mm", taken=coarse, damage=damage.images_interpolated(2))
    yield Condition(what="severe motion and", level="SNR 8", motion="severe", taken={"snr": 8.0})
    yield Condition(what="severe motion and", level="4.4 mm", motion="severe", taken={"thickness_mm": 4.4})
    fifth = {"interleave": 5}
    yield Condition(what="severe motion and", level="every fifth slice in turn", motion="severe", taken=fifth)
    yield Condition(what="severe motion and", level="two stacks", motion="severe", damage=damage.first_stacks(2))
    yield Condition(what=ONE_STACK, level="of another contrast", damage=damage.other_contrast(), fault=LAST)
    yield Condition(what=ONE_STACK, level="slices in reverse order", damage=damage.slices_reversed(), fault=LAST)
    yield Condition(what=ONE_STACK, level="slices sorted by time", damage=damage.halves_swapped(), fault=LAST)
    yield Condition(what=ONE_STACK, level="of another head", damage=damage.stack_of_another(), fault=LAST)


CONDITIONS = tuple(_conditions())


@dataclass(frozen=True, kw_only=True)
class StressedSubject(SubjectSpec):
    """A subject with different acquisition settings.

    Args:
        taken: see `Condition`.
    """

    taken: Mapping[str, Any]

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Acquisition settings of its stacks."""
        return [replace(one, **self.taken) for one in super().acquisition(n_stacks)]


def subject_of(condition: Condition, n: int) -> StressedSubject:
    """Subject `n`, with the same head and motion seed under all conditions."""
    seed, volume = FIRST_SEED + n, VOLUMES[n % len(VOLUMES)]
    taken = "-".join(f"{key}{value:g}" for key, value in condition.taken.items())
    name = f"stress-{seed}-{condition.motion}{'-' * bool(taken)}{taken}"
    return StressedSubject(name=name, volume=volume, motion=condition.motion, seed=seed, taken=dict(condition.taken))


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Tasks for every condition that --cases names of the first subject, then of the next.

    The conditions of an interrupted study then have the same subjects.
    """
    for n in range(options.subjects):
        for condition in CONDITIONS:
            if is_named(key := f"{condition.name} {n}", options.cases):
                yield Task(key, measure, (condition.name, n, options))


def measure(name: str, n: int, options: argparse.Namespace) -> Row:
    """Reconstruct one subject under one condition.

    Args:
        name: of the condition.
        n: number of the subject.
        options: of the command.
    """
    condition = next(one for one in CONDITIONS if one.name == name)
    case = simulated_case(subject_of(condition, n), options.cache)
    other = simulated_case(subject_of(CONDITIONS[0], n + 1), options.cache)
    rng = np.random.default_rng([FIRST_SEED, n])
    stacks = damage.applied(condition.damage, case.stacks, other.stacks, rng)
    lies = len(stacks) - 1 if condition.damage.last_without_truth else None
    known = {key: at for key, at in case.points_mm.items() if key[0] != lies}
    found = outcome(replace(case, stacks=stacks, points_mm=known), options)
    return {"what": condition.what, "level": condition.level} | found


def line(key: str, row: Row) -> str:
    """Progress line of a finished run."""
    figures = f"{row['psnr_db']:.2f} dB, TRE {row['median_mm']:.2f} mm, " if "psnr_db" in row else ""
    return f"{key}: {figures}{'bad' if row['bad'] else 'good'}, {row['reason']}"


def tables(record: Record) -> dict[str, str]:
    """Summary of all runs and a row for each condition, then a table of every run."""
    rows = [{"name": name, **row} for name, row in record["rows"].items()]
    groups = [[row for row in rows if f"{row['what']}: {row['level']}" == one.name] for one in CONDITIONS]
    summary = [{"what": group[0]["what"], "level": group[0]["level"], "of": group} for group in groups if group]
    out, right = count(rows, lacks_a_stack), count(rows, _lacks_the_wrong_one)
    text = (
        f"Preset `{record['preset']}`, {len(rows)} runs. {verdicts(rows, _warning)} In {out} runs a stack was left "
        f"out, in {right} of these the one that was wrong."
    )
    return {"stress-sweep": "\n\n".join([text, table(summary, SUMMARY), details("Every run", table(rows, EACH))])}


def _lacks_the_wrong_one(row: Row) -> bool:
    """Whether the stack with the fault was left out, and no other."""
    return row["what"] == ONE_STACK and row.get("left_out") == [LAST]


def _warning(row: Row) -> str:
    """`TRUE` for a warning about a bad result or an existing fault, else `FALSE`; empty without a warning."""
    if is_use(row):
        return ""
    if row["bad"]:
        return TRUE
    fault = next(one.fault for one in CONDITIONS if one.name == f"{row['what']}: {row['level']}")
    return TRUE if says_unseen(row) or (fault and fault in row["reason"]) else FALSE


def _over(key: str, digits: int, of: Callable[[Sequence[float]], float]) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        values = [one[key] for one in row["of"] if key in one]
        return f"{of(values):.{digits}f}" if values else "-"

    return cell


SUMMARY: dict[str, Cell] = {
    "what is wrong": "{what}",
    "how much": "{level}",
    "PSNR dB": _over("psnr_db", 2, mean),
    "poses mm": _over("median_mm", 2, median),
    "runs": lambda row: len(row["of"]),
    "bad": lambda row: count(row["of"], lambda one: one["bad"]),
    "use": lambda row: count(row["of"], is_use),
    "check": lambda row: count(row["of"], is_check),
    "do not use": lambda row: count(row["of"], is_refused),
}
EACH: dict[str, Cell] = {
    "run": "{name}",
    "PSNR dB": "{psnr_db:.2f}",
    "poses mm": "{median_mm:.2f}",
    "off": "{off_share:.0%}",
    "bad": lambda row: "bad" if row["bad"] else "-",
    "warning": lambda row: _warning(row) or "-",
    "verdict": "{reason}",
}

STUDY = Study(
    name="stress.sweep",
    about="Make one thing wrong at a time in simulated stacks: what it costs, and whether the verdict notices.",
    document="stress.md",
    shared=(*FITS, "--jobs", "--cache", "--cases"),
    options={"--subjects": {"type": int, "default": 3, "metavar": "N", "help": "heads of each condition"}},
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
