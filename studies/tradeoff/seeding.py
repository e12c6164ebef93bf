"""`python -m studies.tradeoff.seeding`: the lattice against error bounds in the whole reconstruction."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from g3r.planning.presets import ADAPTIVE, PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import aligned, figures, registered_once
from studies.subjects import chosen_folders, read_case
from studies.tables import table


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """Every way of seeding, case by case."""
    for folder in chosen_folders(options.folders):
        for bound in (None, *options.bounds):
            name = "lattice" if bound is None else f"{bound:g}"
            yield Task(f"{folder.name}, {name}", measure, (folder, name, bound, options))


def measure(folder: Path, name: str, bound: float | None, options: argparse.Namespace) -> Row:
    """Measure one reconstruction; all ways of a case share its registration.

    Args:
        folder: of the case.
        name: of the bound in the record.
        bound: of adaptive seeding; None seeds on a lattice.
        options: of the command.
    """
    case = read_case(folder)
    settings = PRESETS[options.preset]
    motion = registered_once(folder, options.preset, options.ckpt)
    own = replace(settings, adaptive=None if bound is None else replace(ADAPTIVE, bound=bound))
    result = GaussianReconstructor(options.ckpt, own).reconstruct(case.stacks, motion)
    comparison = aligned(case, result.volume, result.grid, case.pose_error(result.slices).common)
    seconds = result.record.cpu_seconds
    return {
        "case": case.name,
        "bound": name,
        "n_gaussians": len(result.cloud),
        **figures(comparison.scores),
        "prior_cpu_s": seconds["fit to prior"],
        "slices_cpu_s": seconds["fit to slices"],
    }


def tables(record: Record) -> dict[str, str]:
    """PSNR to the truth, Gaussians, CPU seconds of every way."""
    columns = {
        "case": "{case}",
        "bound": "{bound}",
        "Gaussians": "{n_gaussians}",
        "PSNR, dB": "{psnr_db:.2f}",
        "SSIM": "{ssim:.4f}",
        "CPU s, stage 1": "{prior_cpu_s:.1f}",
        "CPU s, stage 2": "{slices_cpu_s:.1f}",
    }
    return {"seeding": table(record["rows"].values(), columns)}


STUDY = Study(
    name="tradeoff.seeding",
    about="The lattice against error bounds in the whole reconstruction: PSNR to the truth, Gaussians, CPU seconds.",
    shared=(*FITS, "folders"),
    options={"--bounds": {"nargs": "*", "type": float, "default": [0.03, 0.05, 0.08], "help": "to compare"}},
    tasks=tasks,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
