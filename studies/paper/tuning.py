"""`python -m studies.paper.tuning`: strengths of the baselines' regularisers, tuned on subjects of no other table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.acquisition.slicing import normalised_slices
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import compare
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.intensity_matching import match_intensities
from studies.harness import Record, Row, Study, Task
from studies.paper.figures import PHANTOMS, suffix
from studies.paper.least_squares import TIKHONOV, TOTAL_VARIATION, least_squares_volume
from studies.paper.subjects import TUNING_SEED, VOXEL_MM, PaperSubject, atlas_heads, paper_case, phantom_heads
from studies.tables import Cell, table

STRENGTHS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)

KINDS = {"Tikhonov": TIKHONOV, "total variation": TOTAL_VARIATION}

STACK_NUMBERS = (3, 1)


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Tasks for two subjects, from three stacks and from one."""
    if options.atlas:
        subjects = atlas_heads(2, "moderate", options.atlas, options.volumes, TUNING_SEED)
    else:
        subjects = phantom_heads(2, "moderate", TUNING_SEED)
    for n in STACK_NUMBERS:
        for spec in subjects:
            yield Task(f"{spec.name}, {n}", measure, (spec, n, options.atlas, options.cache))


def measure(spec: PaperSubject, n_stacks: int, atlas: Path | None, cache: Path) -> Row:
    """PSNR of every kind and strength, in the true poses, so that the strength does not compensate for pose errors.

    Args:
        spec: the subject.
        n_stacks: number of its first stacks to use.
        atlas: of its volume.
        cache: of simulated subjects.
    """
    case = paper_case(spec, atlas, cache, n_stacks)
    volumes, gain = true_volumes(case)
    ones = np.ones(len(gain))
    support = volumes.foreground.support()
    found: dict[str, dict[str, float]] = {}
    for kind, regulariser in KINDS.items():
        found[kind] = {}
        for strength in STRENGTHS:
            data = least_squares_volume(volumes, gain, ones, replace(regulariser, strength=strength))
            made = Volume(np.where(support, data, 0).astype(np.float32), volumes.grid.affine, kind)
            found[kind][f"{strength:g}"] = round(compare(made, case.truth, case.truth_mask).scores.psnr_db, 3)
    return {"subject": spec.name, "n_stacks": n_stacks, "psnr_db": found}


def true_volumes(case: SimulatedCase) -> tuple[InitialVolumes, NDArray[np.float64]]:
    """Initial volumes of a case in its true poses, and the gains [K] of its slices, matched as for the tables."""
    slices = normalised_slices(case.stacks)[0]
    row = {key: n for n, key in enumerate(case.true.keys)}
    order = [row[key] for key in zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True)]
    moved = slices.with_motion(case.true.pose.take(np.array(order)))
    ones = np.ones(len(moved))
    matched = match_intensities(moved, ones, ones)
    return InitialVolumes.of(matched.slices, matched.gain, ones, VOXEL_MM), matched.gain


def tables(record: Record) -> dict[str, str]:
    """Table of the mean PSNR by strength; the best is marked."""
    lines = []
    for n in STACK_NUMBERS:
        rows = [row for row in record["rows"].values() if row["n_stacks"] == n]
        for kind in KINDS if rows else ():
            means = {s: mean(row["psnr_db"][kind][s] for row in rows) for s in rows[0]["psnr_db"][kind]}
            best = max(means, key=lambda s: means[s])
            lines.append(
                {"kind": kind, "n": n} | {s: f"**{v:.2f}**" if s == best else f"{v:.2f}" for s, v in means.items()}
            )
    columns: dict[str, Cell] = {"regulariser": "{kind}", "stacks": "{n}"}
    columns |= {f"s = {strength:g}": itemgetter(f"{strength:g}") for strength in STRENGTHS}
    return {f"paper-tuning{suffix(record)}": f"dB; the best, which the tables use, is bold.\n\n{table(lines, columns)}"}


STUDY = Study(
    name="paper.tuning",
    about="Least squares with Tikhonov's regulariser and with total variation, by their strength, in true poses.",
    document="paper.md",
    shared=("--threads", "--cache"),
    options={
        "--atlas": {"type": Path, "metavar": "DIR", "help": "atlas volumes instead of phantoms"},
        "--volumes": {"nargs": "+", "default": [], "metavar": "GLOB", "help": "of the atlas; none takes all"},
    },
    settings=lambda options: {"subjects": f"volumes of {options.atlas.name}" if options.atlas else PHANTOMS},
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
