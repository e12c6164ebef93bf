"""Shared parts of the commands on a finished run: input folder, output file, and failures as one line."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from g3r._version import __version__
from g3r.cli.failures import INTERRUPTED, run_command
from g3r.errors import InputError

IMAGE_ENDINGS = (".nii", ".nii.gz")

EPILOG = "exit codes: 0 done, 2 usage, 3 bad input or output, 4 out of memory, 130 interrupted"


def reuse_parser(prog: str, description: str) -> argparse.ArgumentParser:
    """A parser with the common arguments of these commands."""
    parser = argparse.ArgumentParser(
        prog=prog, description=f"{description} For research only, not for diagnosis.", epilog=EPILOG
    )
    parser.add_argument("run", metavar="DIR", type=Path, help="output folder of a finished g3r-infer")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return parser


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """Options of the commands that write one image."""
    parser.add_argument("--output", required=True, type=Path, metavar="FILE", help="to write, .nii.gz or .nii")
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")


def check_output_file(options: argparse.Namespace, inputs: Sequence[str | Path] = ()) -> None:
    """Refuse an output file that cannot or must not be written, before any work.

    Args:
        options: has `run`, `output` and `force`.
        inputs: files that are read.

    Raises:
        InputError: the ending is wrong, the folder is missing, or the file exists (without --force) or is an input.
    """
    path: Path = options.output
    if not path.name.endswith(IMAGE_ENDINGS):
        raise InputError(f"{path}: expected a name that ends in .nii.gz or .nii; choose another --output")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it or choose another --output")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; choose another --output")
    own = path.exists() and path.parent.resolve() == options.run.resolve()
    if own and (options.run / "run.json").exists() and _is_of_a_run(path.name):
        raise InputError(f"{path}: is a file of the run; choose another --output")
    if any(Path(one).resolve() == path.resolve() for one in inputs):
        raise InputError(f"{path}: is an input; choose another --output")
    if path.exists() and not options.force:
        raise InputError(f"{path}: exists already; pass --force to replace it, or choose another --output")


def _is_of_a_run(name: str) -> bool:
    from g3r.output.files import OUTPUT_NAMES

    return name in OUTPUT_NAMES


def told(prog: str, work: Callable[[], str]) -> int:
    """Do the work and print its line, or the reason of its failure; returns the exit code.

    Args:
        prog: the command's name.
        work: returns the line to print.
    """
    logging.basicConfig(level=logging.WARNING, format=f"{prog}: %(message)s", stream=sys.stderr)

    def printed() -> int:
        print(work())
        return 0

    return run_command(prog, printed, interrupted=lambda: ("interrupted; nothing was written", INTERRUPTED))
