"""`python -m studies.lesions.kept`: how much of a lesion that slices cover is kept with the prior."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task, positive
from studies.lesions.figure import draw_lesions_kept, save_sections
from studies.lesions.runs import LesionSubject, lesion_run, lesion_subject
from studies.subjects import data_folder
from studies.tables import details, spread, stacks, table

VOLUMES = ("crl-sta/sta24", "crl-sta/sta30", "crl-sta/sta34")
"""Weeks that were used for no training and no choice of settings."""

DEVELOPMENT_VOLUMES = ("spina-bifida/sb26-operated", "spina-bifida/sb30-operated", "spina-bifida/sb33-operated")

FIRST_SEED, DEVELOPMENT_SEED = 52_300, 51_300

STACK_NUMBERS = (3, 1)
WANTED_SHARE = 0.85
"""Smallest accepted ratio of the contrast kept with the prior to the contrast kept without it."""

WITH_PRIOR, WITHOUT_PRIOR, PRIOR_ALONE = "with prior", "without prior", "prior alone"
VARIANTS = (WITHOUT_PRIOR, WITH_PRIOR, PRIOR_ALONE)
KINDS = {"bright": "bright sphere, 6 mm", "dark": "dark sphere, 6 mm", "ventricle": "enlarged ventricle"}


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per head and number of stacks; sections of the first head are saved for the figure."""
    volumes = DEVELOPMENT_VOLUMES if options.development else VOLUMES
    first_seed = DEVELOPMENT_SEED if options.development else FIRST_SEED
    for n in range(options.subjects):
        subject = volumes[n % len(volumes)], first_seed + n
        for n_stacks in options.stacks:
            sections = options.output / f"sections-{n_stacks}.npz" if n == 0 else None
            yield Task(
                f"{subject[0]}, {subject[1]}, {stacks(n_stacks)}", measure, (subject, n_stacks, sections, options)
            )


@functools.lru_cache(maxsize=1)
def sliced(volume: str, seed: int) -> LesionSubject:
    """A head with its lesions, sliced once for all numbers of stacks."""
    return lesion_subject(volume, seed, data_folder("atlas"))


def measure(subject: tuple[str, int], n_stacks: int, sections: Path | None, options: argparse.Namespace) -> Row:
    """Measure how much of each lesion of one head is kept.

    Args:
        subject: atlas volume and seed of the head.
        n_stacks: stacks to reconstruct from.
        sections: .npz for sections of the volumes; None writes none.
        options: of the command.
    """
    settings = PRESETS[options.preset]
    # slices stay at their true poses, otherwise the two reconstructions of a pair would also differ by motion
    settings = replace(
        settings,
        registration=replace(settings.registration, segments=False),
        slice_stage=replace(settings.slice_stage, optimise_poses=False),
    )
    reconstructors = {
        WITHOUT_PRIOR: GaussianReconstructor(None, replace(settings, use_prior=False)),
        WITH_PRIOR: GaussianReconstructor(options.ckpt, settings),
    }
    run = lesion_run(sliced(*subject), n_stacks, reconstructors, PRIOR_ALONE)
    if sections:
        save_sections(run, sections)
    return {"n_stacks": n_stacks, "lesions": run.rows(), "seconds": round(run.seconds, 1)}


def line(key: str, row: Row) -> str:
    """Progress line with the share kept of each lesion."""
    form = "{kind} " + "/".join(f"{{kept[{name}]:.2f}}" for name in VARIANTS)
    shares = ", ".join(form.format_map(one) for one in row["lesions"])
    return f"{key}: {'/'.join(VARIANTS)}: {shares}, {row['seconds']:.0f} s"


def tables(record: Record) -> dict[str, str]:
    """Shares kept by kind and number of stacks, then for every lesion."""
    lesions = [one for row in record["rows"].values() for one in row["lesions"]]
    summary = []
    for n in sorted({one["n_stacks"] for one in lesions}, reverse=True):
        for kind in KINDS:
            of_kind = [one["kept"] for one in lesions if one["kind"] == kind and one["n_stacks"] == n]
            ratios = [kept[WITH_PRIOR] / kept[WITHOUT_PRIOR] for kept in of_kind]
            if of_kind:
                summary.append({"kind": KINDS[kind], "stacks": n, "of": of_kind, "ratios": ratios})

    def share(name: str) -> Any:
        return lambda row: spread([kept[name] for kept in row["of"]])

    columns: dict[str, Any] = {
        "lesion": "{kind}",
        "stacks": "{stacks}",
        "lesions": lambda row: len(row["of"]),
        **{name: share(name) for name in VARIANTS},
        "with / without prior": lambda row: spread(row["ratios"]),
        "smallest": lambda row: f"{min(row['ratios']):.2f}",
        "wanted": lambda _: f"{WANTED_SHARE:.2f}",
    }
    each = {"subject": "{subject}", "stacks": "{n_stacks}", "lesion": "{kind}"}
    each |= {name: f"{{kept[{name}]:.2f}}" for name in VARIANTS}
    parts = [
        f"Preset `{record['preset']}`, weights {record['weights']}. Share of the true contrast that is kept "
        "(1: all, 0: the lesion is not there), mean ± standard deviation over lesions; then the ratio that "
        f"is wanted to be at least {WANTED_SHARE:.2f}.",
        table(summary, columns),
        details("Every lesion", table(lesions, each)),
    ]
    return {"lesions": "\n\n".join(parts)}


def draw(record: Record, options: argparse.Namespace) -> None:
    """Draw sections of the first head for every number of stacks that was measured."""
    rows = list(record["rows"].values())
    name = rows[0]["lesions"][0]["subject"]
    first = [row for row in rows if row["lesions"][0]["subject"] == name]
    found = {row["n_stacks"]: options.output / f"sections-{row['n_stacks']}.npz" for row in first}
    draw_lesions_kept(name, found, VARIANTS, options.figure)


STUDY = Study(
    name="lesions.kept",
    about="Put bright and dark spheres of 6 mm and an enlarged ventricle into heads that no training has seen, "
    "slice them, reconstruct with and without prior, and measure how much of each lesion is kept.",
    document="prior.md",
    picture="lesions.png",
    shared=(*FITS, "--development"),
    options={
        "--subjects": {"type": positive, "default": 3, "metavar": "N", "help": "heads, week after week"},
        "--stacks": {"nargs": "+", "type": int, "choices": STACK_NUMBERS, "default": list(STACK_NUMBERS)},
    },
    tasks=tasks,
    line=line,
    tables=tables,
    figure=draw,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
