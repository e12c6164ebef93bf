"""`python -m studies.stress.drawn`: subjects with random combinations of faults, and whether the verdict notices.

`studies.stress.sweep` has one fault at a time. In hospitals faults are combined, so this study draws head, motion,
number and size of slices, noise, masks, headers and stacks that do not belong independently for each subject.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from data_synth.simulator import StackSettings
from data_synth.slice_profile import Profile
from studies.harness import FITS, Record, Row, Study, Task, positive
from studies.stress import damage
from studies.stress.damage import Damage
from studies.stress.outcome import FALSE, TRUE, count, is_use, lacks_a_stack, outcome, says_unseen, verdicts
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import Cell, details, table

VOLUMES = (
    "crl-sta/sta24",
    "crl-sta/sta30",
    "crl-sta/sta34",
    "spina-bifida/sb33-operated",
    "spina-bifida/sb34-operated",
)
"""Volumes that were not used for training."""

FIRST_SEED = 105_000
"""First seed of this study; seeds of the heads whose stacks spoil another subject begin at FIRST_SEED + OTHERS. No rule
was changed on any of these subjects."""

OTHERS = 500

MOTION_SHARES = {"none": 0.1, "mild": 0.3, "moderate": 0.4, "severe": 0.2}

INTERLEAVE_SHARES = {1: 0.25, 2: 0.35, 3: 0.15, 4: 0.1, 5: 0.1, 6: 0.05}
"""Orders of slices: mostly each in turn or every second, but some scanners step by the root of their number."""

TWO_STACKS_SHARE = 0.3
"""Share of subjects with two stacks; the others have three. A single stack never gets a better verdict than *check*."""

SPOILT_SHARE, LOST_SHARE, STATED_SHARE, GAP_SHARE = 0.25, 0.25, 0.2, 0.3
"""Shares of subjects with a stack that does not belong, slices without a mask, a wrong thickness, and gaps."""

SPOILT: dict[str, Callable[[], Damage]] = {
    "another contrast": damage.other_contrast,
    "reverse order": damage.slices_reversed,
    "sorted by time": damage.halves_swapped,
    "another head": damage.stack_of_another,
}
"""Faults of a last stack that does not belong to the others."""

MASK_PIXELS = (-2, -1, 0, 0, 0, 1, 2, 4)

PROFILES: tuple[Profile, ...] = ("box", "gaussian", "sinc")


@dataclass(frozen=True, kw_only=True)
class DrawnSubject(SubjectSpec):
    """A head and its acquisition settings.

    Args:
        pixel_mm: in-plane spacing.
        thickness_mm: of a slice.
        gap_mm: between the facing edges of neighbouring slices.
        snr: see `StackSettings`.
        interleave: see `StackSettings`.
        oblique_deg: see `StackSettings`.
        profile: through the slice.
    """

    pixel_mm: float
    thickness_mm: float
    gap_mm: float
    snr: float
    interleave: int
    oblique_deg: float
    profile: Profile
    turned: bool = True

    def acquisition(self, n_stacks: int) -> list[StackSettings]:
        """Acquisition settings of its stacks."""
        return [
            replace(
                one,
                resolution_mm=self.pixel_mm,
                thickness_mm=self.thickness_mm,
                gap_mm=self.gap_mm,
                snr=self.snr,
                interleave=self.interleave,
                oblique_deg=self.oblique_deg,
                profile=self.profile,
            )
            for one in super().acquisition(n_stacks)
        ]


@dataclass(frozen=True, kw_only=True)
class Draw:
    """One subject and all faults of its stacks.

    Attributes:
        subject: the head.
        n_stacks: number of stacks.
        spoilt: a key of `SPOILT`, or empty.
        mask_pixels: pixels by which masks are dilated.
        stated: ratio of the stated thickness to the true one.
        lost: share of slices without a mask.
    """

    subject: DrawnSubject
    n_stacks: int
    spoilt: str
    mask_pixels: int
    stated: float
    lost: float

    @property
    def other(self) -> DrawnSubject:
        """A head of another week, scanned in the same way."""
        volume = VOLUMES[(VOLUMES.index(self.subject.volume) + 1) % len(VOLUMES)]
        seed = self.subject.seed + OTHERS
        return replace(self.subject, name=f"drawn-{seed}", volume=volume, seed=seed)

    def damages(self) -> Iterator[Damage]:
        """The damages in their order."""
        yield damage.first_stacks(self.n_stacks)
        if self.spoilt:
            yield SPOILT[self.spoilt]()
        if self.lost:
            yield damage.slices_lost(self.lost)
        if self.mask_pixels:
            yield damage.masks_grown(self.mask_pixels)
        if self.stated != 1:
            yield damage.stated_thickness(self.stated)

    def text(self) -> str:
        """The deviations from a usual subject in words, for tables."""
        one = self.subject
        found = [
            one.volume.rsplit("/", 1)[-1],
            f"motion {one.motion}",
            f"{self.n_stacks} stacks of {one.pixel_mm:.1f} x {one.pixel_mm:.1f} x {one.thickness_mm:.1f} mm",
            f"SNR {one.snr:.0f}",
        ]
        found += [f"gaps {one.gap_mm:.1f} mm"] * bool(one.gap_mm) + [f"bias {one.bias:.2f}"] * (one.bias > 0.1)
        found += [f"every {one.interleave}th slice in turn"] * (one.interleave > 3)
        found += [f"one {self.spoilt}"] * bool(self.spoilt) + [f"{self.lost:.0%} lost"] * bool(self.lost)
        found += [f"masks {self.mask_pixels:+d} pixels"] * bool(self.mask_pixels)
        found += [f"thickness {self.stated - 1:+.0%}"] * (self.stated != 1)
        return ", ".join(found)


def drawn(n: int) -> Draw:
    """Subject `n`."""
    seed = FIRST_SEED + n
    rng = np.random.default_rng([seed, 1])  # the seed alone draws the head and its motion
    thickness_mm = round(float(rng.uniform(2.0, 4.5)), 2)
    subject = DrawnSubject(
        name=f"drawn-{seed}",
        volume=VOLUMES[rng.integers(len(VOLUMES))],
        motion=str(rng.choice(list(MOTION_SHARES), p=list(MOTION_SHARES.values()))),
        seed=seed,
        bias=round(float(rng.uniform(0, 0.25)), 3),
        pixel_mm=round(float(rng.uniform(0.7, 1.3)), 2),
        thickness_mm=thickness_mm,
        gap_mm=round(float(rng.uniform(0.1, 0.4) * thickness_mm), 2) if rng.random() < GAP_SHARE else 0.0,
        snr=round(float(np.exp(rng.uniform(np.log(7), np.log(30)))), 1),
        interleave=int(rng.choice(list(INTERLEAVE_SHARES), p=list(INTERLEAVE_SHARES.values()))),
        oblique_deg=round(float(rng.uniform(0, 10)), 1),
        profile=PROFILES[rng.integers(len(PROFILES))],
    )
    return Draw(
        subject=subject,
        n_stacks=2 if rng.random() < TWO_STACKS_SHARE else 3,
        spoilt=str(rng.choice(list(SPOILT))) if rng.random() < SPOILT_SHARE else "",
        mask_pixels=int(rng.choice(MASK_PIXELS)),
        stated=round(float(rng.uniform(0.7, 1.3)), 2) if rng.random() < STATED_SHARE else 1.0,
        lost=round(float(rng.uniform(0.05, 0.25)), 2) if rng.random() < LOST_SHARE else 0.0,
    )


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per subject."""
    for n in range(options.subjects):
        yield Task(str(n), measure, (n, options))


def measure(n: int, options: argparse.Namespace) -> Row:
    """Reconstruct one subject and compare its verdict with the truth.

    Args:
        n: its number.
        options: of the command.
    """
    one = drawn(n)
    case = simulated_case(one.subject, options.cache)
    other = simulated_case(one.other, options.cache).stacks if one.spoilt == "another head" else case.stacks
    stacks, last = case.stacks, one.n_stacks - 1
    rng = np.random.default_rng([FIRST_SEED, n])
    lies = False
    for each in one.damages():
        stacks = damage.applied(each, stacks, other, rng)
        lies |= each.last_without_truth
    known = {key: at for key, at in case.points_mm.items() if key[0] <= last and not (lies and key[0] == last)}
    row = outcome(replace(case, stacks=stacks, points_mm=known), options)
    spoilt = stacks[last].name if one.spoilt else ""
    return {"drawn": one.text(), "spoilt": spoilt, "mask_pixels": one.mask_pixels} | row


def line(key: str, row: Row) -> str:
    """Progress line of a finished subject."""
    figures = f"{row['psnr_db']:.2f} dB, {row['off_share']:.0%} off, " if "psnr_db" in row else ""
    return f"{key}: {row['drawn']}: {figures}{'bad' if row['bad'] else 'good'}, {row['reason']}"


def tables(record: Record) -> dict[str, str]:
    """Summary sentences about all subjects, then a table of every subject."""
    rows = list(record["rows"].values())
    kept = [row for row in rows if row["spoilt"] and row["spoilt"] not in row.get("left_out", [])]
    psnr_db = [row["psnr_db"] for row in rows if "psnr_db" in row]
    text = (
        f"Preset `{record['preset']}`, {len(rows)} subjects, {median(psnr_db):.2f} dB in the median of {len(psnr_db)}. "
        f"{verdicts(rows, _warning)} Of {count(rows, lambda row: bool(row['spoilt']))} stacks that do not belong "
        f"{count(rows, _lacks_the_spoilt)} were left out; of {count(rows, lambda row: not row['spoilt'])} sets without "
        f"one {count(rows, lambda row: not row['spoilt'] and lacks_a_stack(row))} lost a stack. Where it stayed the "
        f"verdict was *use* in {count(kept, is_use)} of {len(kept)}."
    )
    return {"stress-drawn": f"{text}\n\n{details('Every subject', table(rows, EACH))}"}


def _lacks_the_spoilt(row: Row) -> bool:
    return bool(row["spoilt"]) and row.get("left_out") == [row["spoilt"]]


def _warning(row: Row) -> str:
    """`TRUE` for a warning about a bad result or an existing fault, else `FALSE`; empty without a warning."""
    if is_use(row):
        return ""
    masks = "the mask of" in row["reason"] and row.get("mask_pixels", 0) < 0
    names_a_fault = (row["spoilt"] and row["spoilt"] in row["reason"]) or masks
    return TRUE if row["bad"] or says_unseen(row) or names_a_fault else FALSE


def _figure(key: str, digits: int) -> Callable[[Row], str]:
    return lambda row: f"{row[key]:.{digits}f}" if key in row else "-"


EACH: dict[str, Cell] = {
    "drawn": "{drawn}",
    "PSNR dB": _figure("psnr_db", 2),
    "poses mm": _figure("median_mm", 2),
    "off": lambda row: f"{row['off_share']:.0%}" if "off_share" in row else "-",
    "bad": lambda row: "bad" if row["bad"] else "-",
    "warning": lambda row: _warning(row) or "-",
    "verdict": "{reason}",
}

STUDY = Study(
    name="stress.drawn",
    about="Draw head, motion, slices, noise, masks, headers and spoilt stacks at random: whether the verdict notices.",
    document="stress.md",
    shared=(*FITS, "--jobs", "--cache"),
    options={"--subjects": {"type": positive, "default": 84, "metavar": "N", "help": "how many"}},
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
