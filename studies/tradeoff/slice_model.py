"""`python -m studies.tradeoff.slice_model`: gain by each part of the slice model, on one registration."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import aligned, figures, registered_once
from studies.subjects import case_folders, read_case
from studies.tables import Cell, table

WITHOUT: dict[str, Mapping[str, Any]] = {
    "common bias field": {"common_bias_field": False},
    "surroundings": {"slice_model.surroundings": False},
    "measured profile": {"held_out": None, "slice_model.through_plane": 1.0},
    "less width in plane": {"slice_model.in_plane": 1.0},
    "prior in the volume": {"prior_weight": 0.0},
}
"""The parts, with the settings that leave each out."""

SHIPPED, NONE = "as shipped", "none of these"

VARIANTS: dict[str, Mapping[str, Any]] = {
    SHIPPED: {},
    **{f"without {part}": changes for part, changes in WITHOUT.items()},
    NONE: {name: value for changes in WITHOUT.values() for name, value in changes.items()},
}


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case, which measures all variants."""
    for folder in case_folders(options.cases):
        yield Task(folder.name, measure, (folder, options))


def measure(folder: Path, options: argparse.Namespace) -> Row:
    """Measure every variant on one case.

    Args:
        folder: of the case.
        options: of the command.
    """
    case = read_case(folder)
    registration = registered_once(folder, options.preset, options.ckpt)
    scores, prior = {}, {}
    for name, changes in VARIANTS.items():
        settings = changed(PRESETS[options.preset], changes)
        result = GaussianReconstructor(options.ckpt, settings).reconstruct(case.stacks, registration)
        common = case.pose_error(result.slices).common
        scores[name] = figures(aligned(case, result.volume, result.grid, common).scores)
        if name in (SHIPPED, NONE):
            prior[name] = figures(aligned(case, result.prior, result.prior_grid, common).scores)
    return {"n_stacks": len(case.stacks), "scores": scores, "prior": prior}


def line(key: str, row: Row) -> str:
    """Progress line of a finished case."""
    return f"{key}: " + ", ".join(f"{name} {found['psnr_db']:.2f}" for name, found in row["scores"].items())


def tables(record: Record) -> dict[str, str]:
    """A row per case: dB as shipped, without each part, without all of them; V_prior with and without the field."""
    columns: dict[str, Cell] = {
        "case": "{case}",
        "stacks": "{n_stacks}",
        **{name: f"{{scores[{name}][psnr_db]:.2f}}" for name in VARIANTS},
        "SSIM as shipped / none": f"{{scores[{SHIPPED}][ssim]:.3f}} / {{scores[{NONE}][ssim]:.3f}}",
        "V_prior as shipped / none": f"{{prior[{SHIPPED}][psnr_db]:.2f}} / {{prior[{NONE}][psnr_db]:.2f}}",
    }
    text = table(({"case": case, **row} for case, row in record["rows"].items()), columns)
    return {"slice-model": f"dB; preset `{record['preset']}`, weights {record['weights']}.\n\n{text}"}


STUDY = Study(
    name="tradeoff.slice_model",
    about="Reconstruct the cases with each part of the model of a slice left out in turn.",
    document="tradeoff.md",
    shared=(*FITS, "--cases"),
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
