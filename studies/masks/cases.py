"""`python -m studies.masks.cases`: volumes from stacks in surroundings, with true and with automatic masks.

The truth is black beyond the edge of the brain, but the scene is not. A volume is therefore wrong at the edge wherever
its masks reach beyond the brain, as hand-drawn masks do. To separate this effect from errors of found masks, true masks
with such a rim are measured too, and a second score leaves the edge out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean

import numpy as np
from scipy.ndimage import distance_transform_edt

from g3r.acquisition.images import Volume
from g3r.acquisition.stacks import Stack
from g3r.evaluation.case import SimulatedCase, load_case
from g3r.evaluation.compare import compare
from g3r.evaluation.metrics import score
from g3r.mask_network.mask_shape import as_people_draw
from g3r.reconstruct import GaussianReconstructor
from studies.harness import Record, Row, Study, Task
from studies.masks.overlap import OPTIONS, mask_model, settings
from studies.masks.surrounded import SLICES_BEYOND, surrounded
from studies.subjects import THICKNESS_MM, data_folder
from studies.tables import Cell, table

SEED = 81_000
EDGE_MM = 2.0
"""Voxels less deep in the brain than this do not count in the second score."""


WAYS = ("true", "drawn", "found")


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case, which measures all ways."""
    folders = options.folders or sorted(path for path in data_folder("cases").iterdir() if path.is_dir())
    for n, folder in enumerate(folders):
        yield Task(folder.name, measure, (folder, SEED + n, options))


def measure(folder: Path, seed: int, options: argparse.Namespace) -> Row:
    """Scores of one case with true masks, with true masks and a rim, and with found masks.

    Args:
        folder: of the case.
        seed: of its surroundings.
        options: of the command.
    """
    case = load_case(folder, THICKNESS_MM.get(folder.name))
    stacks = surrounded(case, seed)
    found = [_masked(stack, options.masks) for stack in stacks]
    row: Row = {
        "case": case.name,
        "n_found": sum(stack is not None for stack in found),
        "dice": [_dice(mask, true) for mask, true in zip(found, stacks, strict=True)],
    }
    reconstructor = GaussianReconstructor(settings=options.preset)
    drawn = [replace(stack, mask=as_people_draw(stack.mask, stack.spacing_mm)) for stack in stacks]
    ways: tuple[Sequence[Stack | None], ...] = (stacks, drawn, found)
    for name, masked in zip(WAYS, ways, strict=True):
        if any(stack is not None for stack in masked):
            row |= {f"{name}_{key}": value for key, value in _scores(case, reconstructor, masked).items()}
    return row


def _dice(found: Stack | None, true: Stack) -> float:
    """Dice coefficient of a found mask and the true mask with the rim of hand-drawn masks."""
    if found is None:
        return 0.0
    drawn = as_people_draw(true.mask, true.spacing_mm)
    shared = np.count_nonzero(found.mask & drawn)
    return round(2 * shared / (np.count_nonzero(found.mask) + np.count_nonzero(drawn)), 4)


def _masked(stack: Stack, source: str | None) -> Stack | None:
    """The stack with the mask that the network finds; None if it finds no head."""
    from g3r.mask_network.inference import find_brain

    found = find_brain(stack.image, stack.spacing_mm.tolist(), mask_model(source))
    return replace(stack, mask=found.mask, mask_source="automatic") if found.found else None


def _scores(
    case: SimulatedCase, reconstructor: GaussianReconstructor, stacks: Sequence[Stack | None]
) -> dict[str, float]:
    """Scores of the volume of the stacks that have a mask."""
    numbers = np.array([n for n, stack in enumerate(stacks) if stack is not None])
    result = reconstructor.reconstruct([stack for stack in stacks if stack is not None])
    stack_id, slice_index = numbers[result.slices.stack_id], result.slices.slice_index - SLICES_BEYOND
    slices = replace(result.slices, stack_id=stack_id, slice_index=slice_index)
    error = case.pose_error(slices)
    depth_mm = distance_transform_edt(case.truth_mask, sampling=case.truth.grid.spacing_mm)
    volume = Volume(result.volume, result.grid.moved(error.common).affine, case.name)
    inside = compare(volume, case.truth, depth_mm > EDGE_MM, align=True)
    whole = score(inside.volume, case.truth.data, case.truth_mask)  # aligned without the edge, so it cannot rotate it
    return {
        "psnr_db": round(whole.psnr_db, 3),
        "inner_psnr_db": round(inside.scores.psnr_db, 3),
        "poses_mm": round(error.median_mm, 3),
    }


def line(key: str, row: Row) -> str:
    """Progress line of a finished case."""
    return (
        f"{key}: Dice {mean(row['dice']):.3f}, true masks {row['true_psnr_db']:.2f} dB, "
        f"found masks {row.get('found_psnr_db', float('nan')):.2f} dB"
    )


def _all_ways(row: Row, key: str, digits: int) -> str:
    """A figure with true masks, with true masks and a rim, and with found masks."""
    return " / ".join(f"{row[f'{way}_{key}']:.{digits}f}" for way in WAYS if f"{way}_{key}" in row)


def tables(record: Record) -> dict[str, str]:
    """A row for each case."""
    columns: dict[str, Cell] = {
        "case": "{case}",
        "stacks found": lambda row: f"{row['n_found']} of {len(row['dice'])}",
        "Dice": lambda row: " ".join(f"{one:.3f}" for one in row["dice"]),
        "PSNR, dB": lambda row: _all_ways(row, "psnr_db", 2),
        f"without the outer {EDGE_MM:g} mm, dB": lambda row: _all_ways(row, "inner_psnr_db", 2),
        "poses, mm": lambda row: _all_ways(row, "poses_mm", 2),
    }
    return {"masks-cases": table(list(record["rows"].values()), columns)}


STUDY = Study(
    name="masks.cases",
    about="Put cases of g3r-simulate into surroundings, and reconstruct them with true and with automatic masks.",
    document="masks.md",
    shared=("--preset", "folders"),
    options=OPTIONS,
    settings=settings,
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
