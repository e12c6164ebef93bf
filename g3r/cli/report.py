# PYTHON_ARGCOMPLETE_OK
"""`g3r-report`: report.html of a finished run, one page with its verdict and its volume."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from g3r.cli.completion import parsed
from g3r.cli.reuse_options import reuse_parser, told
from g3r.errors import InputError

PROG = "g3r-report"

PAGE_ENDINGS = (".html", ".htm")


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = reuse_parser(PROG, "Write one page, for any browser and without a network, on the result of a run.")
    parser.add_argument(
        "--stacks",
        nargs="+",
        default=[],
        metavar="NIFTI",
        help="the stacks of the run, in its order: to show slices as they were measured",
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="to write (default: report.html in DIR)")
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parsed(build_parser(), argv)
    return told(PROG, lambda: _report(options))


def _report(options: argparse.Namespace) -> str:
    path = _target(options)
    from g3r.output.record import RunRecord
    from g3r.report.page import write_report
    from g3r.report.verdict import verdict_of

    slices = None
    if options.stacks:
        from g3r.report.stored_slices import stored_slices

        slices = stored_slices(options.run, options.stacks)
    write_report(options.run, slices, path)
    return f"report:  {path}\nverdict: {verdict_of(RunRecord.read(options.run / 'run.json')).line()}"


def _target(options: argparse.Namespace) -> Path:
    """The file to write, checked before any work."""
    from g3r.output.files import REPORT_NAME

    folder: Path = options.run
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; pass the output folder of g3r-infer")
    path: Path = options.output or folder / REPORT_NAME
    if not path.name.endswith(PAGE_ENDINGS):
        raise InputError(f"{path}: expected a name that ends in .html; choose another --output")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it or choose another --output")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; choose another --output")
    if path.exists() and not options.force:
        raise InputError(f"{path}: exists already; pass --force to replace it, or choose another --output")
    return path


if __name__ == "__main__":
    sys.exit(main())
