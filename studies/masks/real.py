"""`python -m studies.masks.real`: brain masks found in real stacks, compared with masks drawn by hand.

The network sees one stack at a time, whereas the masks that `g3r-infer --masks auto` writes are also compared between
stacks. Subjects with at least three stacks are therefore reconstructed with found masks, and then without each stack,
with found and with hand-drawn masks, to compare how well the volumes predict the stack that was left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from g3r.acquisition.images import Volume
from g3r.acquisition.stacks import Stack, load_stack, load_stacks
from g3r.errors import InputError
from g3r.evaluation.held_out_stack import predicted_pixels, score_prediction
from g3r.reconstruct import GaussianReconstructor
from studies.harness import Record, Row, Study, Task
from studies.masks.overlap import EACH, OPTIONS, line, mask_model, overlap, scored, settings
from studies.subjects import data_folder
from studies.tables import Cell, table

MASK_ENDING = "_desc-brain_mask.nii.gz"

ERODED_PIXELS = 4
"""Width of the rim of a drawn mask that does not count when its stack is predicted."""


def stacks_with_masks() -> list[tuple[Path, Path]]:
    """Files of the stacks of `real/` in the test data with their hand-drawn masks.

    Raises:
        InputError: there is none.
    """
    folder = data_folder("real")
    found = []
    for mask in sorted(folder.rglob(f"*{MASK_ENDING}")):
        stack = mask.with_name(mask.name.removesuffix(MASK_ENDING) + ".nii.gz")
        if stack.is_file():
            found.append((stack, mask))
    if not found:
        raise InputError(f"{folder}: no stack with a mask *{MASK_ENDING}; add some, or set G3R_TEST_DATA")
    return found


def subjects_with_masks() -> dict[str, list[tuple[Path, Path]]]:
    """Files of stacks and hand-drawn masks by subject, for subjects with at least three stacks."""
    subjects: dict[str, list[tuple[Path, Path]]] = {}
    for stack, mask in stacks_with_masks():
        subjects.setdefault(stack.name.split("_")[0], []).append((stack, mask))
    return {name: pairs for name, pairs in subjects.items() if len(pairs) > 2}


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """One task per stack, one per subject, and one per stack that is left out."""
    for stack, mask in stacks_with_masks():
        yield Task(_name(stack), measure, (stack, mask, options))
    for name, pairs in subjects_with_masks().items():
        yield Task(f"{name}, written", measure_written, (pairs, options))
        for n, (stack, _) in enumerate(pairs):
            yield Task(f"{_name(stack)}, predicted", measure_predicted, (pairs, n, options))


def _name(stack: Path) -> str:
    return stack.name.removesuffix(".nii.gz")


def measure(stack: Path, mask: Path, options: argparse.Namespace) -> Row:
    """Overlap of the mask that the network finds in one stack with the hand-drawn mask.

    Args:
        stack: its file.
        mask: file of the hand-drawn mask.
        options: of the command.
    """
    true = load_stack(stack, mask)  # the same axis order as the product gives to the network
    return scored(true.image, true.mask, true.spacing_mm.tolist(), options.masks)


def measure_written(pairs: Sequence[tuple[Path, Path]], options: argparse.Namespace) -> Row:
    """Overlap of the masks written for a subject with the hand-drawn masks.

    Args:
        pairs: files of the stacks and of their hand-drawn masks.
        options: of the command.
    """
    drawn = _loaded(pairs)
    written = GaussianReconstructor(settings=options.preset).reconstruct(_found(drawn, options.masks)).stacks
    rows = {}
    for (path, _), one, true in zip(pairs, written, drawn, strict=True):
        volume_ml = round(float(one.mask.sum() * true.grid.voxel_volume_mm3 / 1000), 1)
        rows[_name(path)] = {"volume_ml": volume_ml, **overlap(one.mask, true.mask, true.spacing_mm.tolist())}
    return {"written": rows}


def measure_predicted(pairs: Sequence[tuple[Path, Path]], left_out: int, options: argparse.Namespace) -> Row:
    """Prediction of one stack by volumes of the others, made with found and with drawn masks, where both were seen.

    Args:
        pairs: files of the stacks and of their hand-drawn masks.
        left_out: number of the stack to predict, within its own drawn mask.
        options: of the command.
    """
    stacks = _loaded(pairs)
    target, others = stacks[left_out], [stack for n, stack in enumerate(stacks) if n != left_out]
    reconstructor, pixels = GaussianReconstructor(settings=options.preset), {}
    for name, made_of in (("drawn", others), ("found", _found(others, options.masks))):
        result = reconstructor.reconstruct(made_of)
        volume = Volume(result.volume, result.grid.affine, f"{name} masks")
        pixels[name] = predicted_pixels(volume, target, support=result.mask)
    seen = np.minimum(*(one.seen for one in pixels.values()))
    scores = {
        name: score_prediction(replace(one, seen=seen), target.name, f"{name} masks", ERODED_PIXELS)
        for name, one in pixels.items()
    }
    return {"predicted": {f"{name}_db": round(one.figures()["psnr_db"], 3) for name, one in scores.items()}}


def _loaded(pairs: Sequence[tuple[Path, Path]]) -> list[Stack]:
    return load_stacks([stack for stack, _ in pairs], [mask for _, mask in pairs])


def _found(stacks: Sequence[Stack], source: str | None) -> list[Stack]:
    """The stacks with the masks that the network finds."""
    from g3r.mask_network.inference import find_brain

    masks = [find_brain(stack.image, stack.spacing_mm.tolist(), mask_model(source)).mask for stack in stacks]
    return [replace(stack, mask=mask, mask_source="automatic") for stack, mask in zip(stacks, masks, strict=True)]


def said(key: str, row: Row) -> str:
    """Progress line of a finished measurement."""
    if "written" in row:
        return f"{key}: Dice " + ", ".join(f"{one['dice']:.3f}" for one in row["written"].values())
    if "predicted" in row:
        drawn, found = (row["predicted"][f"{name}_db"] for name in ("drawn", "found"))
        return f"{key}: masks drawn {drawn:.2f} dB, found {found:.2f} dB"
    return line(key, row)


WRITTEN: dict[str, Cell] = {
    **{name: EACH[name] for name in ("stack", "true ml", "found ml", "Dice", "recall", "slices lost")},
    "predicted, masks drawn, dB": lambda row: f"{row['drawn_db']:.2f}" if "drawn_db" in row else "-",
    "predicted, masks found, dB": lambda row: f"{row['found_db']:.2f}" if "found_db" in row else "-",
}
"""Columns of the table of written masks."""


def tables(record: Record) -> dict[str, str]:
    """Tables of the masks that the network finds and of the written masks, a row per stack."""
    rows = record["rows"]
    alone = [{"name": name, **row} for name, row in rows.items() if "dice" in row]
    written = [
        {"name": name, **one, **rows.get(f"{name}, predicted", {}).get("predicted", {})}
        for row in rows.values()
        for name, one in row.get("written", {}).items()
    ]
    return {"masks-real": table(alone, EACH)} | ({"masks-written": table(written, WRITTEN)} if written else {})


STUDY = Study(
    name="masks.real",
    about="Find the brain in the real stacks of the test data that have masks drawn by hand.",
    document="masks.md",
    shared=("--preset",),
    options=OPTIONS,
    settings=settings,
    tasks=tasks,
    line=said,
    tables=tables,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
