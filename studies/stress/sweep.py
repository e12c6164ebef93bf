"""`python -m studies.stress.sweep`: one thing wrong at a time, and whether the verdict says so when it matters."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import mean, median
from typing import Any

import numpy as np

from data_synth.simulator import StackSettings
from g3r.errors import G3RError
from g3r.evaluation.case import SimulatedCase
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from g3r.report.verdict import DO_NOT_USE, USE, verdict_of
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import BAD_OFF_SHARE, aligned, off_share
from studies.stress import damage
from studies.stress.damage import Damage
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import Cell, details, table

VOLUMES = ("crl-sta/sta24", "crl-sta/sta30", "crl-sta/sta34")
"""Weeks that no training has seen."""

FIRST_SEED = 91_000
"""Seeds from here on belong to this study."""

BAD_PSNR_DB = 20.0
"""A result is bad if its volume is worse, or if more than `BAD_OFF_SHARE` of the brain in its slices is off."""

ONE_STACK = "one stack"
"""What is wrong where the others are as they should be."""

LAST = "stack-2.nii.gz"
"""The stack that is spoilt where one is."""

TRUE, FALSE = "true", "false alarm"
"""What a warning is: it names a fault of the stacks, or nothing that is wrong with them."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One thing that differs from three clean stacks with moderate motion.

    Attributes:
        what: differs.
        level: of it.
        motion: of the head.
        taken: settings of the stacks (`StackSettings`) that differ.
        damage: to the stacks afterwards.
        fault: words of a verdict that names what is wrong here, right also where the volume is good.
    """

    what: str
    level: str
    motion: str = "moderate"
    taken: Mapping[str, Any] = field(default_factory=dict)
    damage: Damage = field(default_factory=damage.nothing)
    fault: str = ""

    @property
    def name(self) -> str:
        """Of its rows."""
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
    for pixels in (-4, -2, -1, 1, 2, 4):
        leave_out = "the mask of" if pixels < 0 else ""
        yield Condition(what="masks", level=f"{pixels:+d} pixels", damage=damage.masks_grown(pixels), fault=leave_out)
    yield Condition(what="severe motion and", level="SNR 8", motion="severe", taken={"snr": 8.0})
    yield Condition(what="severe motion and", level="4.4 mm", motion="severe", taken={"thickness_mm": 4.4})
    yield Condition(what="severe motion and", level="two stacks", motion="severe", damage=damage.first_stacks(2))
    yield Condition(what=ONE_STACK, level="of another contrast", damage=damage.other_contrast(), fault=LAST)
    yield Condition(what=ONE_STACK, level="slices in reverse order", damage=damage.slices_reversed(), fault=LAST)
    yield Condition(what=ONE_STACK, level="slices sorted by time", damage=damage.halves_swapped(), fault=LAST)
    yield Condition(what=ONE_STACK, level="of another head", damage=damage.stack_of_another(), fault=LAST)


CONDITIONS = tuple(_conditions())


@dataclass(frozen=True, kw_only=True)
class StressedSubject(SubjectSpec):
    """A subject whose stacks are taken otherwise.

    Args:
        taken: see `Condition`.
    """

    taken: Mapping[str, Any]

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """How its stacks are taken."""
        return [replace(one, **self.taken) for one in super().acquisition(n_stacks)]


def subject_of(condition: Condition, n: int) -> StressedSubject:
    """Subject `n`; its head and the seed of its motion are the same under all conditions."""
    seed, volume = FIRST_SEED + n, VOLUMES[n % len(VOLUMES)]
    taken = "-".join(f"{key}{value:g}" for key, value in condition.taken.items())
    name = f"stress-{seed}-{condition.motion}{'-' * bool(taken)}{taken}"
    return StressedSubject(name=name, volume=volume, motion=condition.motion, seed=seed, taken=dict(condition.taken))


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Every condition of the first subject, then of the next: what an interrupted study holds is comparable."""
    for n in range(options.subjects):
        for condition in CONDITIONS:
            yield Task(f"{condition.name} {n}", measure, (condition.name, n, options))


def measure(name: str, n: int, options: argparse.Namespace) -> Row:
    """One subject under one condition.

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
    known = {key: at for key, at in case.points_mm.items() if key[0] not in condition.damage.without_truth}
    row: Row = {"what": condition.what, "level": condition.level}
    try:
        found = _scores(replace(case, stacks=stacks, points_mm=known), options)
    except G3RError as error:
        return row | {"word": "refused", "reason": str(error), "bad": True}
    return row | found


def _scores(case: SimulatedCase, options: argparse.Namespace) -> Row:
    result = GaussianReconstructor(options.ckpt, PRESETS[options.preset]).reconstruct(case.stacks)
    error, verdict = case.pose_error(result.slices), verdict_of(result.record)
    psnr_db = aligned(case, result.volume, result.grid, error.common).scores.psnr_db
    off = off_share(error.per_slice_mm, result.slices, result.weight)
    return {
        "psnr_db": round(psnr_db, 3),
        "median_mm": round(error.median_mm, 4),
        "off_share": round(off, 4),
        "word": verdict.word,
        "reason": verdict.line(),
        "left_out": [stack.name for stack in result.record.stacks if stack.quality and stack.quality.left_out],
        "bad": off > BAD_OFF_SHARE or psnr_db < BAD_PSNR_DB,
    }


def line(key: str, row: Row) -> str:
    """A finished run."""
    figures = f"{row['psnr_db']:.2f} dB, TRE {row['median_mm']:.2f} mm, " if "psnr_db" in row else ""
    return f"{key}: {figures}{'bad' if row['bad'] else 'good'}, {row['reason']}"


def tables(record: Record) -> dict[str, str]:
    """A sentence on all runs and a row for each condition; every run below."""
    rows = [{"name": name, **row} for name, row in record["rows"].items()]
    groups = [[row for row in rows if f"{row['what']}: {row['level']}" == one.name] for one in CONDITIONS]
    summary = [{"what": group[0]["what"], "level": group[0]["level"], "of": group} for group in groups if group]
    bad, good = [row for row in rows if row["bad"]], [row for row in rows if not row["bad"]]
    text = (
        f"Preset `{record['preset']}`, {len(rows)} runs. Of {len(bad)} bad ones the verdict was *do not use*, or a "
        f"refusal, in {_count(bad, _is_refused)}, *check* in {_count(bad, _is_check)} and *use* in "
        f"{_count(bad, _is_use)}. Of {len(good)} good ones it was *use* in {_count(good, _is_use)}, *check* in "
        f"{_count(good, _is_check)} and *do not use* in {_count(good, _is_refused)}; in "
        f"{_count(good, _says_unseen)} of these because a part of the brain was not seen. Of the warnings about good "
        f"ones {_count(good, lambda row: _warning(row) == TRUE)} name what is wrong with the stacks, "
        f"{_count(good, lambda row: _warning(row) == FALSE)} are false alarms. In "
        f"{_count(rows, _lacks_a_stack)} runs a stack was left out, in {_count(rows, _lacks_the_wrong_one)} of these "
        f"the one that was wrong."
    )
    return {"stress-sweep": "\n\n".join([text, table(summary, SUMMARY), details("Every run", table(rows, EACH))])}


def _is_use(row: Row) -> bool:
    return row["word"] == USE


def _lacks_a_stack(row: Row) -> bool:
    """Whether the volume was made without a stack that was given."""
    return bool(row.get("left_out"))


def _lacks_the_wrong_one(row: Row) -> bool:
    """Whether the one stack that was spoilt was left out, and no other."""
    return row["what"] == ONE_STACK and row.get("left_out") == [LAST]


def _says_unseen(row: Row) -> bool:
    """Whether the verdict says that the volume is incomplete, which pose errors and PSNR do not count as bad."""
    return not _is_use(row) and "not seen by any slice" in row["reason"]


def _warning(row: Row) -> str:
    """Whether a warning is about a bad result or names a fault that the stacks have; empty where there is none."""
    if _is_use(row):
        return ""
    if row["bad"]:
        return TRUE
    fault = next(one.fault for one in CONDITIONS if one.name == f"{row['what']}: {row['level']}")
    return TRUE if _says_unseen(row) or (fault and fault in row["reason"]) else FALSE


def _is_refused(row: Row) -> bool:
    return row["word"] in (DO_NOT_USE, "refused")


def _is_check(row: Row) -> bool:
    return not _is_use(row) and not _is_refused(row)


def _count(rows: Sequence[Row], holds: Callable[[Row], bool]) -> int:
    return sum(map(holds, rows))


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
    "bad": lambda row: _count(row["of"], lambda one: one["bad"]),
    "use": lambda row: _count(row["of"], _is_use),
    "check": lambda row: _count(row["of"], _is_check),
    "do not use": lambda row: _count(row["of"], _is_refused),
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
    shared=(*FITS, "--jobs", "--cache"),
    options={"--subjects": {"type": int, "default": 3, "metavar": "N", "help": "heads of each condition"}},
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
