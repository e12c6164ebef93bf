"""`python -m studies.prior.ablation`: gain of the fit by the prior, by number of stacks."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from g3r.evaluation.case import SimulatedCase
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.prior.figures import draw_ablation
from studies.runs import aligned, figures
from studies.subjects import SubjectSpec, simulated_case
from studies.tables import details, spread, stacks, table

VOLUMES = (
    "crl-sta/sta24",
    "crl-sta/sta30",
    "crl-sta/sta34",
    "spina-bifida/sb25-operated",
    "spina-bifida/sb27-operated",
    "spina-bifida/sb29-operated",
    "spina-bifida/sb31-operated",
    "spina-bifida/sb33-operated",
)
"""Volumes that were not used for training. No network was trained on weeks 24, 30 and 34, but on their neighbours, and
other simulations of them were looked at. The operated volumes belong to another atlas, whose volumes before operation
were trained on; checkpoints were chosen on operated volumes."""

GROUPS = {"sta": "crl-sta/", "sb": "spina-bifida/"}

FIRST_SEED, DEVELOPMENT_SEED = 52_000, 51_000
"""First seeds of the published table, and of subjects that may be looked at during development."""

MOTION = "mild"
STACK_NUMBERS = (1, 2, 3)

BASELINE = "fit without prior"

FITS_COMPARED: dict[str, Mapping[str, Any]] = {
    BASELINE: {"use_prior": False},
    "prior as initialisation": {"distillation": False},
    "with distillation": {"several_stacks_distilled": True},
}
"""Variants of the fit, as changes of the settings (see `g3r.planning.presets.changed`); the last is the
product from one stack, the second from several."""

VARIANTS = ("V_coarse", "V_sharp", "prior alone", *FITS_COMPARED)
"""All variants in the order of the table."""


def specs(*, development: bool = False) -> list[SubjectSpec]:
    """The subjects; always the same."""
    first = DEVELOPMENT_SEED if development else FIRST_SEED
    return [SubjectSpec(volume=volume, motion=MOTION, seed=first + n) for n, volume in enumerate(VOLUMES)]


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per subject and number of stacks, the longest first, so that workers finish at the same time."""
    chosen = [s for s in specs(development=options.development) if any(word in s.name for word in options.subjects)]
    for n in sorted(options.stacks, reverse=True):
        for spec in chosen:
            yield Task(f"{spec.name}, {stacks(n)}", measure_subject, (spec, n, options))


def measure_subject(spec: SubjectSpec, n_stacks: int, options: argparse.Namespace) -> Row:
    """Measure one subject from its first stacks.

    Args:
        spec: of the subject.
        n_stacks: stacks to use.
        options: of the command.
    """
    row = measure(simulated_case(spec, options.cache, n_stacks), options)
    return {"subject": spec.name, "n_stacks": n_stacks, "volume": spec.volume, **row}


def measure(case: SimulatedCase, options: argparse.Namespace) -> Row:
    """Scores of every variant of one subject, after one common registration."""
    settings, ckpt = PRESETS[options.preset], options.ckpt
    start = time.perf_counter()
    motion = GaussianReconstructor(ckpt, settings).register_stacks(case.stacks)
    seconds = {"registration": round(time.perf_counter() - start, 2)}
    scores: dict[str, dict[str, float]] = {}
    tre: dict[str, float] = {}
    for name, changes in FITS_COMPARED.items():
        start = time.perf_counter()
        result = GaussianReconstructor(ckpt, changed(settings, changes)).reconstruct(case.stacks, motion)
        seconds[name] = round(time.perf_counter() - start, 2)
        error = case.pose_error(result.slices)
        tre[name] = error.median_mm
        volumes = {name: (result.volume, result.grid)}
        if name == BASELINE:
            # the volume that is used in place of a prior
            volumes |= {"V_coarse": (result.coarse, result.prior_grid), "V_sharp": (result.prior, result.prior_grid)}
        elif name == VARIANTS[-1]:
            volumes["prior alone"] = result.prior, result.prior_grid
        scores |= {what: figures(aligned(case, *of, error.common).scores) for what, of in volumes.items()}
    return {"scores": {name: scores[name] for name in VARIANTS}, "median_mm": tre, "seconds": seconds}


def line(key: str, row: Row) -> str:
    """Progress line of a finished measurement."""
    listed = ", ".join(f"{variant} {row['scores'][variant]['psnr_db']:.2f}" for variant in VARIANTS)
    return f"{key}: {listed} dB, {sum(row['seconds'].values()):.0f} s"


def tables(record: Record) -> dict[str, str]:
    """Tables of mean and spread of each variant for all subjects and by atlas; then of every subject."""
    rows = sorted(record["rows"].values(), key=lambda row: (row["subject"], row["n_stacks"]))
    numbers = sorted({row["n_stacks"] for row in rows})
    of_group = {group: [row for row in rows if row["volume"].startswith(prefix)] for group, prefix in GROUPS.items()}
    columns = [("variant", "{name}"), *(column for n in numbers for column in _columns(n))]
    by_group = [
        {"name": f"{name}, {group}", "variant": name, "of": found}
        for group, found in of_group.items()
        for name in (BASELINE, VARIANTS[-1])
        if found
    ]
    counts = ", ".join(f"{len({row['subject'] for row in found})} {group}" for group, found in of_group.items())
    parts = [
        f"{len({row['subject'] for row in rows})} subjects ({counts}), {MOTION} motion, preset "
        f"`{record['preset']}`, weights {record['weights']}. Mean and standard deviation over subjects; the last "
        "column of each number of stacks is the paired difference.",
        table([{"name": name, "variant": name, "of": rows} for name in VARIANTS], columns),
        "By atlas:",
        table(by_group, columns),
        _worst(rows, numbers),
        details(
            "Every subject: dB, and median TRE in mm of the last variant",
            table(
                rows,
                {
                    "subject": "{subject}",
                    "stacks": "{n_stacks}",
                    **{name: f"{{scores[{name}][psnr_db]:.2f}}" for name in VARIANTS},
                    "TRE": f"{{median_mm[{VARIANTS[-1]}]:.2f}}",
                },
            ),
        ),
    ]
    return {"ablation": "\n\n".join(parts)}


def _columns(n: int) -> list[tuple[str, Any]]:
    """The columns of a number of stacks."""

    def difference(row: Row) -> str:
        return "" if row["variant"] == BASELINE else spread(differences_db(row["of"], row["variant"], n), "{:+.2f}")

    return [
        (f"{stacks(n)}: dB", lambda row: spread(values(row["of"], row["variant"], n, "psnr_db"))),
        ("SSIM", lambda row: spread(values(row["of"], row["variant"], n, "ssim"), "{:.3f}")),
        ("to without prior, dB", difference),
    ]


def differences_db(rows: Sequence[Row], variant: str, n_stacks: int) -> list[float]:
    """PSNR differences of a variant to the fit without prior, subject by subject.

    Args:
        rows: of the record.
        variant: one of `VARIANTS`.
        n_stacks: only rows with this number of stacks.
    """
    pairs = zip(values(rows, variant, n_stacks, "psnr_db"), values(rows, BASELINE, n_stacks, "psnr_db"), strict=True)
    return [one - other for one, other in pairs]


def values(rows: Sequence[Row], variant: str, n_stacks: int, key: str) -> list[float]:
    """One score of a variant, subject by subject.

    Args:
        rows: one per subject and number of stacks.
        variant: name of the variant.
        n_stacks: only rows with this number of stacks.
        key: name of the score.
    """
    return [row["scores"][variant][key] for row in rows if row["n_stacks"] == n_stacks]


def _worst(rows: Sequence[Row], numbers: Sequence[int]) -> str:
    least = []
    for n in numbers:
        found = differences_db(rows, VARIANTS[-1], n)
        better = sum(value > 0 for value in found)
        least.append(f"{stacks(n)}: {min(found):+.2f} dB ({better} of {len(found)} better)")
    return f"The least that the prior with distillation brings to any subject: {'; '.join(least)}."


STUDY = Study(
    name="prior.ablation",
    about="Reconstruct subjects that no training has seen from one, two and three stacks, without prior, "
    "with the prior as the start, and with distillation.",
    document="prior.md",
    picture="prior-ablation.png",
    shared=(*FITS, "--jobs", "--cache", "--development"),
    options={
        "--subjects": {"nargs": "+", "metavar": "WORD", "default": [""], "help": "names that contain one"},
        "--stacks": {"nargs": "+", "type": int, "choices": STACK_NUMBERS, "default": list(STACK_NUMBERS)},
    },
    tasks=tasks,
    line=line,
    tables=tables,
    figure=lambda record, options: draw_ablation(list(record["rows"].values()), VARIANTS, BASELINE, options.figure),
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
