"""`python -m studies.paper.real`: real stacks without truth: each is predicted by volumes that were made without it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.acquisition.stacks import Stack, load_stack, load_stacks
from g3r.bench.record import machine_line
from g3r.errors import InputError
from g3r.evaluation.held_out_stack import ERODED_PIXELS, predicted_pixels, score_prediction
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from studies.harness import DOCS, FITS, Record, Row, Study, Task
from studies.masks.real import stacks_with_masks
from studies.paper.least_squares import least_squares_volume, tuned
from studies.paper.methods import PRIOR, PRODUCT, SCATTER, SQUARES, VARIATION
from studies.paper.posed import volumes_without_network
from studies.paper.real_pictures import Shown, draw_real, keep_predictions, largest_slice
from studies.tables import Cell, details, spread, table

METHODS = (PRODUCT, PRIOR, SCATTER, SQUARES, VARIATION)

SCORES = {
    "psnr_db": ("PSNR, dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "ncc": ("NCC", "{:.4f}"),
    "high_pass_ncc": ("high-pass NCC", "{:.4f}"),
    "counted_share": ("counted", "{:.2f}"),
}
"""Column heading and format of each score, by its key."""


@dataclass(frozen=True, kw_only=True)
class RealSubject:
    """Stacks of one head, and repeated stacks that no volume is made from.

    Attributes:
        stacks, masks: files, one mask for each stack.
        repeats, repeat_masks: files of the repeated stacks and their masks.
    """

    stacks: tuple[Path, ...]
    masks: tuple[Path, ...]
    repeats: tuple[Path, ...] = ()
    repeat_masks: tuple[Path, ...] = ()


def subjects(options: argparse.Namespace) -> list[RealSubject]:
    """The subject whose files were given, or those of `real/` in the test data, one folder each.

    Raises:
        InputError: no test data, fewer than two stacks, or another number of masks.
    """
    if options.stacks:
        if options.publish or options.docs:
            raise InputError("--publish, --docs: documents show stacks that are free; leave out --stacks")
        own = RealSubject(
            stacks=tuple(options.stacks),
            masks=tuple(options.masks),
            repeats=tuple(options.held_out),
            repeat_masks=tuple(options.held_out_mask),
        )
        found = [own]
    else:
        pairs = stacks_with_masks()
        folders = dict.fromkeys(stack.parent for stack, _ in pairs)
        of = {folder: [pair for pair in pairs if pair[0].parent == folder] for folder in folders}
        found = [RealSubject(stacks=tuple(s for s, _ in one), masks=tuple(m for _, m in one)) for one in of.values()]
    for one in found:
        if len(one.stacks) < 2 or len(one.masks) != len(one.stacks) or len(one.repeats) != len(one.repeat_masks):
            raise InputError(
                f"{len(one.stacks)} stacks, {len(one.masks)} masks, {len(one.repeats)} --held-out, "
                f"{len(one.repeat_masks)} --held-out-mask; expected two or more stacks, and a mask for each"
            )
    return found


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """A task per left-out stack of each subject, then one with all stacks if there are repeats to predict."""
    for n, subject in enumerate(subjects(options), 1):
        for k in range(len(subject.stacks)):
            yield Task(f"subject {n} without stack {k + 1}", measure, (subject, n, k, options))
        if subject.repeats:
            yield Task(f"subject {n} of all stacks", measure, (subject, n, None, options))


def measure(subject: RealSubject, number: int, left_out: int | None, options: argparse.Namespace) -> Row:
    """One reconstruction, and the predictions of its volume and of the other volumes in its poses.

    Args:
        subject: its files.
        number: of the subject.
        left_out: number of the stack that is left out and predicted; None predicts the repeats from all stacks.
        options: of the command.
    """
    n_stacks = len(subject.stacks)
    thickness: list[float | None] = [options.thickness] * n_stacks
    stacks = load_stacks(subject.stacks, subject.masks, thickness)
    if left_out is None:
        pairs = zip(subject.repeats, subject.repeat_masks, strict=True)
        held_out = {f"repeat {k}": load_stack(*pair, options.thickness) for k, pair in enumerate(pairs, 1)}
        used = stacks
    else:
        held_out = {f"stack {left_out + 1}": stacks[left_out]}
        used = stacks[:left_out] + stacks[left_out + 1 :]
    result = GaussianReconstructor(options.ckpt, PRESETS[options.preset]).reconstruct(used)
    volumes = volumes_of(result, used)
    head = result.mask.astype(np.float32)
    row: Row = {"subject": number, "of": len(used), "seconds": round(sum(result.record.seconds.values()), 1)}
    row["scores"] = {}
    for name, stack in held_out.items():
        shown = {}
        scores = {}
        for method, (data, grid) in volumes.items():
            # all methods are scored on the same pixels: the brain of the written volume
            support = on_grid(head, result.grid, grid, 0.0) > 0.5
            volume = Volume(data, grid.affine, method)
            found = predicted_pixels(volume, stack, support=support)
            scores[method] = score_prediction(found, stack.name, method, options.eroded_pixels).figures()
            k = largest_slice(found)
            shown[method] = Shown.of(on_grid(data, grid, result.grid, 0.0), result.mask, found, k)
        keep_predictions(sections(options, number, name), shown)
        row["scores"][name] = scores
    return row


def volumes_of(result: ReconstructionResult, stacks: Sequence[Stack]) -> dict[str, tuple[NDArray[Any], VolumeGrid]]:
    """All volumes in the poses of a result, with their grids; none is cut at a mask.

    Least-squares volumes that are cut at a mask are aligned slightly worse and lose up to 0.07 dB.

    Args:
        result: of the stacks.
        stacks: that it was made from.
    """
    own, gain = volumes_without_network(stacks, result)
    widths = result.record.held_out.widths if result.record.held_out else None
    made = {SCATTER: own.coarse}
    # strengths tuned on atlas volumes, because they are real brains and phantoms are not
    for name, regulariser in zip((SQUARES, VARIATION), tuned(True, len(stacks)), strict=True):
        made[name] = least_squares_volume(own, gain, result.weight, regulariser, widths)
    return {
        PRODUCT: (result.volume, result.grid),
        PRIOR: (result.prior, result.prior_grid),
        **{name: (data, own.grid) for name, data in made.items()},
    }


def sections(options: argparse.Namespace, number: int, name: str) -> Path:
    """File with the data of the picture of a held-out stack.

    Args:
        options: of the command.
        number: of the subject.
        name: of the stack.
    """
    return Path(options.output) / "sections" / f"{number}-{name.replace(' ', '-')}.npz"


def settings(options: argparse.Namespace) -> Record:
    """Settings that the rows of the record depend on."""
    files = [str(path) for one in subjects(options) for path in (*one.stacks, *one.masks, *one.repeats)]
    return {"files": files, "thickness_mm": options.thickness, "eroded_pixels": options.eroded_pixels}


def line(key: str, row: Row) -> str:
    """Progress line of a finished reconstruction."""
    texts = []
    for stack, scores in row["scores"].items():
        found = ", ".join(f"{method} {one['psnr_db']:.2f}" for method, one in scores.items())
        texts.append(f"{stack} predicted by {found} dB")
    return f"{key}: {row['seconds']:.0f} s; {'; '.join(texts)}"


def tables(record: Record) -> dict[str, str]:
    """Table of means over the held-out stacks, and table of every stack."""
    rows = list(record["rows"].values())
    held_out = [
        {"subject": row["subject"], "stack": stack, "of": row["of"], "scores": scores}
        for row in rows
        for stack, scores in row["scores"].items()
    ]
    if not held_out:
        return {"paper-real": "Not measured yet."}

    def cell(key: str, form: str) -> Cell:
        return lambda method: spread([one["scores"][method["name"]][key] for one in held_out], form)

    columns: dict[str, Cell] = {"method": "{name}"}
    columns |= {head: cell(key, form) for key, (head, form) in SCORES.items()}
    n_subjects = len({row["subject"] for row in rows})
    made = (
        f"Preset `{record['preset']}`, weights {record['weights']}, {record['threads']} threads; subjects: "
        f"{n_subjects}, held-out stacks: {len(held_out)}; mean and standard deviation over these. The rim of "
        f"{record['eroded_pixels']} pixels does not count. A reconstruction took "
        f"{mean(row['seconds'] for row in rows):.0f} s. {machine_line(record['machine'])}"
    )
    each: dict[str, Cell] = {"held out": "subject {subject}, {stack}", "made of": "{of} stacks"}
    each |= {f"{name}, dB": _psnr(name) for name in METHODS}
    return {
        "paper-real": "\n\n".join(
            [made, table([{"name": name} for name in METHODS], columns), details("Every stack", table(held_out, each))]
        )
    }


def _psnr(method: str) -> Cell:
    def cell(one: Mapping[str, Any]) -> str:
        return f"{one['scores'][method]['psnr_db']:.2f}"

    return cell


def finish(record: Record, options: argparse.Namespace) -> None:
    """Draw the picture, if requested.

    Raises:
        InputError: it would be written into docs/, where no picture of a patient belongs, or its slices were not kept.
    """
    path = options.picture
    if path is None:
        return
    if path.resolve().is_relative_to(DOCS):
        raise InputError(f"--picture {path}: pictures of patients do not belong in docs/; choose another folder")
    names = [(row["subject"], name) for row in record["rows"].values() for name in row["scores"]]
    if not 0 < options.picture_of <= len(names):
        raise InputError(f"--picture-of {options.picture_of}; expected 1 to {len(names)}")
    kept = sections(options, *names[options.picture_of - 1])
    if not kept.is_file():
        raise InputError(f"{kept}: no such file; measure again with --fresh")
    draw_real(kept, METHODS, path)


STUDY = Study(
    name="paper.real",
    about="Real stacks, which have no truth: g3r, its prior, the coarse volume and least squares, each made without a "
    "stack that they then predict; and repeats, predicted from all stacks.",
    document="paper.md",
    shared=FITS,
    options={
        "--stacks": {"nargs": "+", "type": Path, "default": [], "metavar": "NIFTI", "help": "(none: the test data's)"},
        "--masks": {"nargs": "+", "type": Path, "default": [], "metavar": "NIFTI", "help": "brain masks of --stacks"},
        "--held-out": {"nargs": "+", "type": Path, "default": [], "metavar": "NIFTI", "help": "repeats, predicted"},
        "--held-out-mask": {"nargs": "+", "type": Path, "default": [], "metavar": "NIFTI", "help": "masks of those"},
        "--thickness": {"type": float, "metavar": "MM", "help": "of all slices (None: of the sidecars)"},
        "--eroded-pixels": {"type": int, "default": ERODED_PIXELS, "metavar": "N", "help": "rim that does not count"},
        "--picture": {"type": Path, "metavar": "PNG", "help": "also draw volumes and a predicted slice, not in docs/"},
        "--picture-of": {"type": int, "default": 1, "metavar": "N", "help": "which held-out stack it shows"},
    },
    settings=settings,
    tasks=tasks,
    line=line,
    tables=tables,
    finish=finish,
)

if __name__ == "__main__":
    sys.exit(STUDY.main())
