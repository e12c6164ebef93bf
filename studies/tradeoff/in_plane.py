"""`python -m studies.tradeoff.in_plane`: choice of the in-plane width of the PSF, on cases and on real stacks.

The slices alone do not determine their in-plane blur: a sharper volume with more blur gives the same pixels. Cases with
a known truth are therefore scored, and real stacks are predicted with several blurs, of which the best counts for each
volume.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from g3r.acquisition.images import Volume
from g3r.acquisition.stacks import Stack, load_stacks
from g3r.evaluation.held_out_stack import predict_stack
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from studies.harness import FITS, Record, Row, Study, Task
from studies.masks.real import stacks_with_masks
from studies.runs import aligned, figures, registered_once
from studies.subjects import case_folders, read_case
from studies.tables import Cell, table

WIDTHS = (1.0, 0.85, 0.75, 0.65, 0.55)
"""In-plane widths relative to the nominal width; 0.57 has the variance of a box of one pixel."""

JUDGED = (0.3, 0.6, 0.8, 1.0)
"""Widths with which a held-out stack is simulated from a finished volume."""

ERODED_PIXELS = 4
"""Width of the rim of the mask that is left out, because masks of different stacks differ there anyway."""


def _key(width: float) -> str:
    """Name of a width in a row; a format would read a plain number as a position."""
    return f"width {width:g}"


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per case, then one per real stack that is predicted from the others."""
    for folder in case_folders(options.cases):
        yield Task(folder.name, measure, (folder, options))
    for name, pairs, left_out in real_stacks_left_out():
        yield Task(name, predict, (pairs, left_out, options))


def real_stacks_left_out() -> Iterator[tuple[str, list[tuple[Path, Path]], int]]:
    """Name of each real stack, files of the stacks of its head with their masks, and its number among them."""
    pairs = stacks_with_masks()
    for pair in pairs:
        of_head = [one for one in pairs if one[0].parent == pair[0].parent]
        yield f"real, without {pair[0].name.removesuffix('.nii.gz')}", of_head, of_head.index(pair)


def measure(folder: Path, options: argparse.Namespace) -> Row:
    """Measure one case with every width, on one registration.

    Args:
        folder: of the case.
        options: of the command.
    """
    case, scores = read_case(folder), {}
    registration = registered_once(folder, options.preset, options.ckpt)
    for width in WIDTHS:
        settings = changed(PRESETS[options.preset], {"slice_model.in_plane": width})
        result = GaussianReconstructor(options.ckpt, settings).reconstruct(case.stacks, registration)
        common = case.pose_error(result.slices).common
        scores[_key(width)] = figures(aligned(case, result.volume, result.grid, common).scores)["psnr_db"]
    return {"psnr_db": scores}


def predict(pairs: list[tuple[Path, Path]], left_out: int, options: argparse.Namespace) -> Row:
    """Prediction of a held-out stack by volumes of every width.

    Args:
        pairs: stacks of one head and their masks.
        left_out: number of the stack that is predicted.
        options: of the command.
    """
    stacks = load_stacks([stack for stack, _ in pairs], [mask for _, mask in pairs])
    used, held_out = stacks[:left_out] + stacks[left_out + 1 :], stacks[left_out]
    registration = GaussianReconstructor(options.ckpt, PRESETS[options.preset]).register_stacks(used)
    psnr_db: dict[str, dict[str, float]] = {}
    for width in WIDTHS:
        settings = changed(PRESETS[options.preset], {"slice_model.in_plane": width})
        result = GaussianReconstructor(options.ckpt, settings).reconstruct(used, registration)
        psnr_db[_key(width)] = predictions(result, held_out)
    return {"predicted_db": psnr_db}


def predictions(result: ReconstructionResult, held_out: Stack) -> dict[str, float]:
    """PSNR of the prediction of a stack, by the in-plane width with which the prediction is simulated.

    Args:
        result: with the volume.
        held_out: a stack that it was not made from.
    """
    volume, fwhm, found = Volume(result.volume, result.grid.affine, "volume"), held_out.in_plane_fwhm_pixels, {}
    for judged in JUDGED:
        seen = replace(held_out, in_plane_fwhm_pixels=(judged * fwhm[0], judged * fwhm[1]))
        predicted = predict_stack(volume, seen, support=result.mask, eroded_pixels=ERODED_PIXELS)
        found[f"{judged:g}"] = predicted.figures()["psnr_db"]
    return found


def best_prediction(result: ReconstructionResult, held_out: Stack) -> float:
    """The highest PSNR of `predictions`.

    Args:
        result: with the volume.
        held_out: a stack that it was not made from.
    """
    return max(predictions(result, held_out).values())


def line(key: str, row: Row) -> str:
    """Progress line of a finished case or stack."""
    found = row.get("psnr_db") or {width: max(of.values()) for width, of in row["predicted_db"].items()}
    return f"{key}: " + ", ".join(f"{width}: {psnr:.2f}" for width, psnr in found.items())


def tables(record: Record) -> dict[str, str]:
    """Tables of PSNR by the width of the fit, and for real stacks also by the width of the prediction."""
    rows = record["rows"].items()
    of_width: dict[str, Cell] = {f"{width:g}": f"{{psnr_db[{_key(width)}]:.2f}}" for width in WIDTHS}
    cases = table(({"case": key, **row} for key, row in rows if "psnr_db" in row), {"case": "{case}", **of_width})
    real: list[dict[str, Any]] = [
        {"stack": key.removeprefix("real, "), "judged": judged, "psnr_db": found}
        for key, row in rows
        if "predicted_db" in row
        for judged in row["predicted_db"][_key(WIDTHS[0])]
        for found in [{width: of[judged] for width, of in row["predicted_db"].items()}]
    ]
    predicted = table(real, {"real stacks": "{stack}", "simulated with": "{judged}", **of_width})
    head = f"PSNR in dB by the width in plane over the nominal one; preset `{record['preset']}`."
    return {"in-plane": "\n\n".join([head, cases, *([predicted] if real else [])])}


STUDY = Study(
    name="tradeoff.in_plane",
    about="Reconstruct cases and real stacks with several widths of the slice profile in plane.",
    document="tradeoff.md",
    shared=(*FITS, "--cases"),
    tasks=tasks,
    line=line,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
