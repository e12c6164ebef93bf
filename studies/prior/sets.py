"""`python -m studies.prior.sets`: loss with the weights that were trained only on data in the public domain."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import mean

from g3r.checkpoints.shipped import SET_NAMES
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import Record, Row, Study, Task
from studies.holes import Hole, with_holes
from studies.subjects import case_folders, read_case
from studies.tables import Cell, table
from studies.unseen.cases import CASES
from studies.unseen.measurement import scored, truly_unseen

USUAL = "usual"
SETS: dict[str, str | None] = {USUAL: None, **{name: name for name in SET_NAMES}}
"""Values of --ckpt by the names of the sets."""


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case and set of weights: the complete stacks, and those with the holes of the case, if any."""
    for folder in case_folders(options.cases):
        subjects: list[tuple[str, int | None, tuple[Hole, ...]]] = [(folder.name, None, ())]
        subjects += [
            (f"{folder.name}, {what}", one.n_stacks, one.holes)
            for what, one in CASES.items()
            if one.case == folder.name
        ]
        for name, n_stacks, holes in subjects:
            for set_name in SETS:
                yield Task(f"{name}: {set_name}", measure, (name, set_name, folder, n_stacks, holes, options))


def measure(
    name: str, set_name: str, folder: Path, n_stacks: int | None, holes: tuple[Hole, ...], options: argparse.Namespace
) -> Row:
    """Measure one case with one set of weights.

    Args:
        name: of the case, with its holes.
        set_name: of `SETS`.
        folder: of the case.
        n_stacks: number of stacks to use; None takes all.
        holes: missing slices.
        options: of the command.
    """
    case = read_case(folder, n_stacks)
    case = replace(case, stacks=with_holes(case.stacks, holes))
    start = time.perf_counter()
    result = GaussianReconstructor(SETS[set_name], PRESETS[options.preset]).reconstruct(case.stacks)
    seconds = time.perf_counter() - start
    error = case.pose_error(result.slices)
    unseen = truly_unseen(case)
    volumes = {"V_prior": (result.prior, result.prior_grid), "volume": (result.volume, result.grid)}
    true_mm3 = float(case.truth_mask.sum()) * case.truth.grid.voxel_volume_mm3
    return {
        "case": name,
        "set": set_name,
        **error.figures(),
        "volume_error": float(result.mask.sum()) * result.grid.voxel_volume_mm3 / true_mm3 - 1,
        "scores": {one: scored(case, *volume, error.common, unseen) for one, volume in volumes.items()},
        "seconds": round(seconds, 1),
    }


def tables(record: Record) -> dict[str, str]:
    """A row per case with all sets side by side, and the mean."""
    by_case: dict[str, dict[str, Row]] = {}
    for row in record["rows"].values():
        by_case.setdefault(row["case"], {})[row["set"]] = row
    complete = {case: rows for case, rows in by_case.items() if len(rows) == len(SETS)}

    def both(form: str) -> Cell:
        return lambda found: " / ".join(_cell(form, found[name]) for name in SETS)

    columns: dict[str, Cell] = {
        "case": lambda found: found[USUAL]["case"],
        "TRE mm, median": both("{median_mm:.2f}"),
        "brain volume": both("{volume_error:+.1%}"),
        "V_prior, dB": both("{scores[V_prior][whole]:.2f}"),
        "volume, dB": both("{scores[volume][whole]:.2f}"),
        "volume, unseen dB": both("{scores[volume][unseen]:.1f}"),
    }
    costs = "; ".join(
        f"{name} costs {_lost(complete, name, 'V_prior'):.2f} dB of V_prior and {_lost(complete, name, 'volume'):.2f} "
        "dB of the volume in the mean"
        for name in SET_NAMES
    )
    head = f"{' / '.join(SETS)}; preset `{record['preset']}`."
    return {"sets": "\n\n".join([head, table(complete.values(), columns), f"{costs}."])}


def _cell(form: str, row: Row) -> str:
    try:
        return form.format_map(row)
    except KeyError:
        return "-"


def _lost(by_case: dict[str, dict[str, Row]], name: str, volume: str) -> float:
    def whole(row: Row) -> float:
        return float(row["scores"][volume]["whole"])

    return mean(whole(found[USUAL]) - whole(found[name]) for found in by_case.values())


STUDY = Study(
    name="prior.sets",
    about="Reconstruct the cases of the test data with each set of weights that ships with the package.",
    document="prior.md",
    shared=("--preset", "--threads", "--jobs", "--cases"),
    tasks=tasks,
    line=lambda key, row: (
        f"{key}: TRE {row['median_mm']:.2f} mm, {row['scores']['volume']['whole']:.2f} dB, {row['seconds']:.0f} s"
    ),
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
