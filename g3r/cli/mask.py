# PYTHON_ARGCOMPLETE_OK
"""`g3r-mask`: brain masks of stacks, without a reconstruction."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from g3r._version import __version__
from g3r.cli.completion import parsed
from g3r.cli.failures import fail, run_command
from g3r.cli.mask_options import add_masker_options, check_masker_options, check_threads, mask_weights_path, masker_of
from g3r.errors import InputError
from g3r.run.idle_threads import let_threads_sleep
from g3r.run.stop_request import StopRequest

if TYPE_CHECKING:
    from g3r.acquisition.brain_mask import FoundMask
    from g3r.checkpoints.weights_file import WeightsFile
    from g3r.masking.find import Masker

PROG = "g3r-mask"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog=PROG,
        description="Find the fetal brain in stacks of slices: a mask and a picture of each. Look at the pictures. "
        "For research only, not for diagnosis.",
        epilog="exit codes: 0 done, 2 usage, 3 a stack could not be read or shows no head (the others are done), "
        "130 or 143 interrupted",
    )
    parser.add_argument("stacks", nargs="+", metavar="STACK", help="NIfTI files, of one subject or of many")
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder to write into")
    add_masker_options(parser)
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads (default: all cores)")
    parser.add_argument("--force", action="store_true", help="replace masks that are there")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parsed(parser, argv)
    check_masker_options(parser, options)
    check_threads(parser, options)
    let_threads_sleep()
    logging.basicConfig(level=logging.WARNING, format=f"{PROG}: %(message)s", stream=sys.stderr)
    stop_request = StopRequest()

    def work() -> int:
        with stop_request, _silent("g3r.acquisition.slice_profile"):  # the slice thickness does not matter here
            return _run(options)

    line = "interrupted; masks that were printed are whole"
    return run_command(PROG, work, interrupted=lambda: (line, stop_request.exit_code))


@contextmanager
def _silent(name: str) -> Iterator[None]:
    """Silence a logger, except for errors, during the block."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _run(options: argparse.Namespace) -> int:
    from g3r.masking.names import mask_name

    names = [mask_name(path) for path in options.stacks]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{twice[0]}.nii.gz: two stacks would have this mask; mask them into folders of their own")
    there = [name for name in names if (options.output / f"{name}.nii.gz").exists()]
    if there and not options.force:
        raise InputError(f"{options.output / there[0]}.nii.gz: exists already; pass --force to replace it")
    masker = masker_of(options, _weights(options))
    options.output.mkdir(parents=True, exist_ok=True)
    exit_code = 0
    for path, name in zip(options.stacks, names, strict=True):
        try:
            print(_mask(path, options.output / name, masker))
        except InputError as error:
            exit_code = fail(PROG, str(error), error.exit_code)
    return exit_code


def _weights(options: argparse.Namespace) -> WeightsFile | None:
    """The file of the mask network; None if a command makes the masks."""
    if options.mask_command:
        return None
    from g3r.checkpoints.weights_file import read_weights

    return read_weights(mask_weights_path(options.mask_ckpt), "mask")


def _mask(path: str, target: Path, masker: Masker) -> str:
    """Write the mask of one stack, its picture and its record; returns a line about it.

    Args:
        path: path of the stack.
        target: path of the files to write, without an ending.
        masker: finds the mask.

    Raises:
        InputError: the stack cannot be read or shows no head, or the masker failed.
    """
    from g3r.acquisition.brain_mask import empty_background_mask
    from g3r.acquisition.images import load_volume, save_volume
    from g3r.acquisition.stacks import load_stack
    from g3r.output.mask_picture import save_mask_picture

    volume = load_volume(path)
    found = empty_background_mask(volume) or masker(path, volume)
    if isinstance(found, str):
        raise InputError(f"{volume.name}: {found}; draw the mask by hand, or try --mask-command")
    stack = load_stack(path, found, float(volume.grid.spacing_mm.max()))
    save_mask_picture(target.with_name(f"{target.name}.png"), [stack])
    volume_ml = volume.grid.volume_ml(found.inside)
    target.with_name(f"{target.name}.json").write_text(_record(path, found, volume_ml), encoding="utf-8")
    save_volume(target.with_name(f"{target.name}.nii.gz"), found.inside, volume.affine)
    return f"{target}.nii.gz: {volume_ml:.0f} ml, {found.source} ({found.detail})"


def _record(path: str, found: FoundMask, volume_ml: float) -> str:
    """A sidecar with BIDS's fields for masks, and our own."""
    fields = {
        "Type": "Brain",
        "Sources": [Path(path).name],
        "GeneratedBy": [{"Name": PROG, "Version": __version__}],
        "MaskSource": found.source,
        "MaskDetail": found.detail,
        "VolumeMl": round(volume_ml, 1),
    }
    return json.dumps(fields, indent=2) + "\n"


if __name__ == "__main__":
    sys.exit(main())
