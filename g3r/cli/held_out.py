"""`g3r-evaluate` without a truth: scores of a volume by its prediction of a held-out stack."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Sequence
from statistics import mean
from typing import TYPE_CHECKING, Any

from g3r.planning import PRESET_NAMES

if TYPE_CHECKING:
    from g3r.evaluation.held_out_stack import StackPrediction

logger = logging.getLogger(__name__)

LOW_CORRELATION = 0.6
"""Below this correlation the stack was hardly found in the volume, and its scores may be of a wrong pose."""

TAKEN = {
    "reference": (("volume", "reference", "mask"), ("align", "sections", "poses", "slices", "lpips_weights")),
    "held_out_stack": (("volume", "mask"), ("held_out_stack", "thickness", "support", "eroded_pixels")),
    "leave_one_out": (("stacks", "masks"), ("leave_one_out", "thickness", "preset", "ckpt", "eroded_pixels")),
}
"""Options that each way of scoring requires, and those that it accepts; all others would be ignored."""

COLUMNS = {
    "PSNR dB": ("psnr_db", ".2f"),
    "SSIM": ("ssim", ".4f"),
    "NCC": ("ncc", ".4f"),
    "median": ("median_ncc", ".4f"),
    "high-pass NCC": ("high_pass_ncc", ".4f"),
    "counted": ("counted_share", ".1%"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of both ways of scoring without a truth."""
    group = parser.add_argument_group("without a truth")
    group.add_argument("--held-out-stack", metavar="NIFTI", help="score how well --volume predicts this stack")
    group.add_argument(
        "--leave-one-out", action="store_true", help="reconstruct without each of --stacks in turn, and predict it"
    )
    group.add_argument("--stacks", nargs="+", metavar="NIFTI", help="of --leave-one-out, at least two")
    group.add_argument("--masks", nargs="+", metavar="NIFTI", help="brain masks of --stacks, same order")
    group.add_argument(
        "--thickness", nargs="+", type=float, metavar="MM", help="slice thickness, as g3r-infer takes it"
    )
    group.add_argument("--preset", choices=PRESET_NAMES, help="of --leave-one-out (default: balanced)")
    group.add_argument("--ckpt", metavar="PRIOR.safetensors", help="of --leave-one-out, as g3r-infer takes it")
    group.add_argument("--support", metavar="NIFTI", help="voxels of --volume that count (default: those not zero)")
    group.add_argument(
        "--eroded-pixels", type=int, metavar="N", help="rim of the masks that does not count (default 1)"
    )


def check_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> bool:
    """Whether a stack is to be predicted; ends the program with 2 if options cannot be combined."""
    if options.held_out_stack and options.leave_one_out:
        parser.error("--held-out-stack and --leave-one-out exclude each other")
    way = "held_out_stack" if options.held_out_stack else "leave_one_out" if options.leave_one_out else "reference"
    needed, further = TAKEN[way]
    missing = [_option(name) for name in needed if getattr(options, name) is None]
    if missing:
        parser.error(f"the following arguments are required: {', '.join(missing)}")
    every = {name for one in TAKEN.values() for names in one for name in names}
    unused = sorted(every - {*needed, *further})
    ignored = [_option(name) for name in unused if getattr(options, name) not in (None, False)]
    if ignored:
        parser.error(f"{', '.join(ignored)} cannot go with {_option(way)}")
    if options.eroded_pixels is None:
        options.eroded_pixels = 1
    if options.eroded_pixels < 0:
        parser.error(f"--eroded-pixels {options.eroded_pixels}; expected 0 or above")
    n_stacks = len(options.stacks or "1")
    if options.leave_one_out and (n_stacks < 2 or len(options.masks) != n_stacks):
        parser.error("--leave-one-out needs two or more --stacks, and --masks in the same order")
    if options.thickness and len(options.thickness) not in (1, n_stacks):
        parser.error(f"{len(options.thickness)} thicknesses for {n_stacks} stacks; give one, or one per stack")
    return way != "reference"


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Predict stacks and print a row for each; returns the scores for --json.

    Raises:
        InputError: inputs cannot be used, or a stack is not found in the volume.
    """
    rows = []
    print("  ".join(f"{name:>8}" for name in COLUMNS), " stack")
    for found in _left_out(options) if options.leave_one_out else (_held_out(options),):
        print(line(found.figures(), found.stack), flush=True)
        if found.search_correlation < LOW_CORRELATION:
            logger.warning("%s: found at a correlation of %.2f only", found.stack, found.search_correlation)
        rows.append(found)
    if len(rows) > 1:
        print(line({name: mean(row.figures()[name] for row in rows) for name, _ in COLUMNS.values()}, "mean"))
    return {"stacks": [row.record() for row in rows]}


def line(figures: dict[str, float], name: str) -> str:
    """A row of the table."""
    cells = (f"{format(figures[key], form):>{max(8, len(head))}}" for head, (key, form) in COLUMNS.items())
    return "  ".join(cells) + f"  {name}"


def _held_out(options: argparse.Namespace) -> StackPrediction:
    from g3r.acquisition.images import load_mask, load_volume
    from g3r.acquisition.stacks import load_stack
    from g3r.evaluation.held_out_stack import predict_stack

    volume = load_volume(options.volume)
    support = load_mask(options.support, volume) if options.support else None
    stack = load_stack(options.held_out_stack, options.mask, options.thickness[0] if options.thickness else None)
    return predict_stack(volume, stack, support=support, eroded_pixels=options.eroded_pixels)


def _left_out(options: argparse.Namespace) -> Iterator[StackPrediction]:
    from g3r.acquisition.images import Volume
    from g3r.acquisition.stacks import load_stacks
    from g3r.evaluation.held_out_stack import predict_stack
    from g3r.planning.presets import PRESETS
    from g3r.reconstruct import GaussianReconstructor

    n_stacks = len(options.stacks)
    stacks = load_stacks(options.stacks, options.masks, _one_each(options.thickness, n_stacks))
    reconstructor = GaussianReconstructor(options.ckpt, PRESETS[options.preset or "balanced"])
    for n, stack in enumerate(stacks):
        result = reconstructor.reconstruct(stacks[:n] + stacks[n + 1 :])
        volume = Volume(result.volume, result.grid.affine, f"the volume without {stack.name}")
        yield predict_stack(volume, stack, eroded_pixels=options.eroded_pixels)


def _one_each(thickness_mm: Sequence[float] | None, n_stacks: int) -> list[float] | None:
    if not thickness_mm:
        return None
    return list(thickness_mm) if len(thickness_mm) == n_stacks else list(thickness_mm) * n_stacks
