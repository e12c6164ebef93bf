"""`python -m studies.masks.simulated`: brain masks found in simulated stacks, with and without a head."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from functools import cache
from statistics import median

import numpy as np

from data_synth.atlas import TruthVolume, find_subjects
from data_synth.heads import load_head
from studies.harness import Record, Row, Study, Task
from studies.masks.overlap import EACH, OPTIONS, line, scored, settings
from studies.subjects import data_folder
from studies.tables import details, table

VOLUMES = ("crl-sta/sta24", "crl-sta/sta30", "crl-sta/sta34")
"""Volumes that were used neither for training nor for the choice of a checkpoint."""
DEVELOPMENT_VOLUMES = ("spina-bifida/sb26-operated", "spina-bifida/sb29-operated", "spina-bifida/sb33-operated")
"""Volumes for development, since checkpoints were chosen on operated volumes."""
FIRST_SEED, DEVELOPMENT_SEED = 71_000, 70_000
N_HEADS, N_WITHOUT = 100, 20
PIXEL_RANGE_MM = (0.7, 1.5)
HEAD_SPACING_MM = 1.2
NEAR_MM = 5.0
MIN_TRUE_ML = 5.0
"""Stacks with less brain than this are drawn again, because there is nothing to reconstruct."""


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per stack; stacks without a head come last."""
    for n in range(options.heads + options.without):
        volumes = DEVELOPMENT_VOLUMES if options.development else VOLUMES
        name = volumes[n % len(volumes)]
        without = n >= options.heads
        key = f"{'without head' if without else name.rsplit('/', 1)[-1]} {n}"
        yield Task(key, measure, (name, n, without, options))


def measure(name: str, n: int, without: bool, options: argparse.Namespace) -> Row:
    """Overlap of the found mask with the true mask of one simulated stack.

    Args:
        name: of the atlas subject.
        n: number of the stack.
        without: whether it shows no head.
        options: of the command.
    """
    from data_synth.mask_data import new_scene
    from data_synth.mask_samples import full_stack
    from data_synth.mask_scans import draw_scan
    from g3r.mask_network.mask_shape import as_people_draw

    rng = np.random.default_rng([DEVELOPMENT_SEED if options.development else FIRST_SEED, n])
    while True:
        scan = draw_scan(new_scene(_head(name), rng), rng, without)
        pixel = float(rng.uniform(*PIXEL_RANGE_MM))
        image, true = full_stack(scan, pixel, rng)
        volume_ml = float(true.sum()) * pixel**2 * scan.spacing_mm / 1000
        if (volume_ml >= MIN_TRUE_ML) != without:
            break
    if without:
        true[:] = False
    spacing_mm = np.array([pixel, pixel, scan.spacing_mm])
    return scored(image, as_people_draw(true, spacing_mm), spacing_mm.tolist(), options.masks)


@cache
def _head(name: str) -> TruthVolume:
    from data_synth.mask_head import filled_head

    return filled_head(load_head(find_subjects(data_folder("atlas"), include=[name])[0], HEAD_SPACING_MM))


def tables(record: Record) -> dict[str, str]:
    """Summary of all stacks, then a row for each."""
    rows = [{"name": name, **row} for name, row in record["rows"].items()]
    heads, without = [row for row in rows if row["head"]], [row for row in rows if not row["head"]]
    false = sum(row["found"] for row in without)
    text = f"{len(without)} stacks without a head: in {false} of them one was found."
    if heads:
        dice = sorted(row["dice"] for row in heads)
        near = sum(row["centre_mm"] is not None and row["centre_mm"] <= NEAR_MM for row in heads)
        text = (
            f"{len(heads)} stacks with a head: found in {sum(row['found'] for row in heads)}, centre within "
            f"{NEAR_MM:g} mm in {near}; Dice {median(dice):.3f} in the median, {np.percentile(dice, 5):.3f} at the "
            f"5th percentile; {sum(row['lost_slices'] for row in heads)} slices lost. {text}"
        )
    return {"masks-simulated": f"{text}\n\n{details('Every stack', table(rows, EACH))}"}


STUDY = Study(
    name="masks.simulated",
    about="Find the brain in simulated stacks with everything around the head, and in stacks without a head.",
    document="masks.md",
    shared=("--development",),
    options={
        **OPTIONS,
        "--heads": {"type": int, "default": N_HEADS, "metavar": "N", "help": "stacks with a head"},
        "--without": {"type": int, "default": N_WITHOUT, "metavar": "N", "help": "stacks without"},
    },
    settings=settings,
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
