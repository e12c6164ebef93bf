"""`python -m studies.tradeoff.lattices`: gain and cost of the mean of fits on shifted lattices.

Cases with a known truth are scored. Real stacks are predicted from the others, with the best of several blurs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from g3r.acquisition.stacks import load_stacks
from g3r.planning.presets import PRESETS, changed
from g3r.planning.stages import Stage
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.runs import aligned, figures, registered_once
from studies.subjects import case_folders, read_case
from studies.tables import Cell, table
from studies.tradeoff.in_plane import best_prediction, real_stacks_left_out

NUMBERS = (1, 3, 6)


def _key(number: int) -> str:
    """Name of a number of lattices in a row; a format would read a plain number as a position."""
    return f"lattices {number}"


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case, then one per real stack that is predicted from the others."""
    for folder in case_folders(options.cases):
        yield Task(folder.name, measure, (folder, options))
    for name, pairs, left_out in real_stacks_left_out():
        yield Task(name, predict, (pairs, left_out, options))


def measure(folder: Path, options: argparse.Namespace) -> Row:
    """Measure one case with every number of lattices, on one registration.

    Args:
        folder: of the case.
        options: of the command.
    """
    case, scores, cpu_s = read_case(folder), {}, {}
    registration = registered_once(folder, options.preset, options.ckpt)
    for number in NUMBERS:
        settings = changed(PRESETS[options.preset], {"n_lattices": number})
        result = GaussianReconstructor(options.ckpt, settings).reconstruct(case.stacks, registration)
        common = case.pose_error(result.slices).common
        scores[_key(number)] = figures(aligned(case, result.volume, result.grid, common).scores)["psnr_db"]
        cpu_s[_key(number)] = round(result.record.cpu_seconds[Stage.FIT_TO_SLICES], 1)
    return {"psnr_db": scores, "cpu_s": cpu_s}


def predict(pairs: list[tuple[Path, Path]], left_out: int, options: argparse.Namespace) -> Row:
    """Prediction of a held-out stack by the volumes.

    Args:
        pairs: stacks of one head and their masks.
        left_out: number of the stack that is predicted.
        options: of the command.
    """
    stacks = load_stacks([stack for stack, _ in pairs], [mask for _, mask in pairs])
    used, held_out = stacks[:left_out] + stacks[left_out + 1 :], stacks[left_out]
    registration = GaussianReconstructor(options.ckpt, PRESETS[options.preset]).register_stacks(used)
    scores, cpu_s = {}, {}
    for number in NUMBERS:
        settings = changed(PRESETS[options.preset], {"n_lattices": number})
        result = GaussianReconstructor(options.ckpt, settings).reconstruct(used, registration)
        scores[_key(number)] = best_prediction(result, held_out)
        cpu_s[_key(number)] = round(result.record.cpu_seconds[Stage.FIT_TO_SLICES], 1)
    return {"psnr_db": scores, "cpu_s": cpu_s}


def line(key: str, row: Row) -> str:
    """Progress line of a finished case or stack."""
    return f"{key}: " + ", ".join(f"{name}: {psnr:.2f}" for name, psnr in row["psnr_db"].items())


def tables(record: Record) -> dict[str, str]:
    """Tables of PSNR and seconds of the fit by the number of lattices."""
    columns: dict[str, Cell] = {"case": "{case}"}
    for number in NUMBERS:
        columns[f"{number}, dB"] = f"{{psnr_db[{_key(number)}]:.2f}}"
    for number in NUMBERS:
        columns[f"{number}, CPU s"] = f"{{cpu_s[{_key(number)}]:.0f}}"
    rows = table(({"case": key, **row} for key, row in record["rows"].items()), columns)
    head = (
        f"PSNR, and CPU seconds of the fit to the slices, by the number of lattices; preset `{record['preset']}`. Real "
        "stacks are predicted from the others, with the best of several blurs."
    )
    return {"lattices": f"{head}\n\n{rows}"}


STUDY = Study(
    name="tradeoff.lattices",
    about="Reconstruct cases and real stacks as the mean of fits on one, three and six lattices.",
    document="tradeoff.md",
    shared=(*FITS, "--cases"),
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
