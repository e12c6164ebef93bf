"""`python -m studies.paper.compare`: the paper's tables and figures with this code, baselines and other programs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import mean

from g3r.bench.record import machine_line
from studies.harness import FITS, Record, Row, Study, Task, positive
from studies.paper.ablation import measure_variants
from studies.paper.figures import PHANTOMS, draw, suffix
from studies.paper.methods import measure_methods
from studies.paper.peers import measure_peer, peer
from studies.paper.scores import why_no_lpips
from studies.paper.subjects import N_SUBJECTS, PaperSubject, atlas_heads, phantom_heads
from studies.paper.tables import CONDITIONS, main_tables, stages_table, variants_table
from studies.subjects import is_named
from studies.tables import stacks

STACK_NUMBERS = (3, 2, 1)


def heads(motion: str, options: argparse.Namespace) -> list[PaperSubject]:
    """The subjects with a level of motion."""
    if options.atlas:
        return atlas_heads(options.subjects, motion, options.atlas, options.volumes)
    return phantom_heads(N_SUBJECTS, motion)[: options.subjects]


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """The tasks of `all_tasks` whose key has a part that matches --cases."""
    for task in all_tasks(options):
        if is_named(task.key, options.cases):
            yield task


def all_tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Tasks of all methods and subjects, three stacks with moderate motion first; then the variants of Fig. 4A."""
    why = why_no_lpips(options.lpips_weights)
    options.with_lpips = not why
    if why:
        print(f"without LPIPS: {why}", file=sys.stderr)
    for motion, n in CONDITIONS:
        for spec in heads(motion, options):
            yield Task(f"{spec.name}, {stacks(n)}", measure_methods, (spec, n, options))
            for one in options.peer:
                yield Task(f"{spec.name}, {stacks(n)}, {one.name}", measure_peer, (spec, n, one, options))
    for spec in heads("moderate", options):
        for n in STACK_NUMBERS:
            yield Task(f"{spec.name}, variants from {stacks(n)}", measure_variants, (spec, n, options))


def line(key: str, row: Row) -> str:
    """Progress line of a finished measurement."""
    if "skipped" in row:
        return f"{key}: skipped"
    found = {name: one.get("mask", one)["psnr_db"] for name, one in row["scores"].items()}
    return f"{key}: {', '.join(f'{name} {psnr:.2f}' for name, psnr in found.items())} dB"


def settings(options: argparse.Namespace) -> Record:
    """Settings that the rows of the record depend on."""
    return {
        "subjects": f"volumes of {options.atlas.name}" if options.atlas else PHANTOMS,
        "why_no_lpips": why_no_lpips(options.lpips_weights),
    }


def tables(record: Record) -> dict[str, str]:
    """All tables, with their subjects and settings."""
    rows = [row for row in record["rows"].values() if "skipped" not in row]
    seconds = mean(row["seconds"] for row in rows if "stages" in row) if any("stages" in r for r in rows) else 0
    made = (
        f"Preset `{record['preset']}`, weights {record['weights']}, {record['threads']} threads, subjects: "
        f"{record['subjects']}. Mean and standard deviation over subjects. {machine_line(record['machine'])}"
    )
    if record["why_no_lpips"]:
        made += f" LPIPS is left out: {record['why_no_lpips']}."
    texts = {
        "paper-methods": f"{made}\n\n{main_tables(record)}" if seconds else made,
        "paper-variants": variants_table(record),
        "paper-stages": stages_table(record),
    }
    return {f"{name}{suffix(record)}": text for name, text in texts.items()}


STUDY = Study(
    name="paper.compare",
    about="Subjects of 21 to 38 weeks that neither training nor settings saw, three orthogonal stacks of "
    "0.8 x 0.8 x 2.2 mm: the product, baselines and other programs, and the product without its parts.",
    document="paper.md",
    picture="paper-methods.png",
    shared=(*FITS, "--jobs", "--cache", "--cases"),
    options={
        "--subjects": {"type": positive, "default": N_SUBJECTS, "metavar": "N", "help": "how many"},
        "--atlas": {"type": Path, "metavar": "DIR", "help": "atlas volumes instead of phantoms (see g3r-pretrain)"},
        "--volumes": {"nargs": "+", "default": [], "metavar": "GLOB", "help": "of the atlas; none takes all"},
        "--peer": {"type": peer, "action": "append", "default": [], "metavar": "NAME=COMMAND", "help": "see peers.py"},
        "--peer-timeout": {"type": float, "default": 3600.0, "metavar": "SECONDS", "help": "of a peer's command"},
        "--lpips-weights": {"type": Path, "metavar": "PATH", "help": "AlexNet and heads (None: torch's cache)"},
    },
    settings=settings,
    tasks=tasks,
    line=line,
    tables=tables,
    figure=draw,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
