# PYTHON_ARGCOMPLETE_OK
"""`g3r-export-poses`: the slice poses of a finished run in the file formats of other programs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from g3r.cli.completion import parsed
from g3r.cli.reuse_options import reuse_parser, told

PROG = "g3r-export-poses"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = reuse_parser(PROG, "Write the slice poses of a finished run as files of other programs.")
    parser.add_argument(
        "--format",
        required=True,
        choices=("itk", "mirtk", "nesvor"),
        help="itk: a .tfm per slice; mirtk: a rigid .dof per slice; nesvor: a folder of slices with poses in their "
        "headers, and the slices that the model predicts",
    )
    pixels = parser.add_mutually_exclusive_group()
    pixels.add_argument(
        "--stacks",
        nargs="+",
        metavar="NIFTI",
        help="of the run, in its order: their pixels for --format nesvor (without them only predicted slices)",
    )
    pixels.add_argument("--slices", metavar="DIR", help="the same of a run that was made with g3r-infer --slices DIR")
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder to write; new or empty")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parsed(parser, argv)
    for name in ("stacks", "slices"):
        if getattr(options, name) and options.format != "nesvor":
            parser.error(f"--{name} and --format {options.format} exclude each other: such files hold no pixels")
    return told(PROG, lambda: _export(options))


def _export(options: argparse.Namespace) -> str:
    from g3r.run.output_folder import OutputFolder, check_output_folder

    check_output_folder(options.output, (), replace=False, inputs=options.stacks or ())
    from g3r.errors import cannot_be_written
    from g3r.reuse.finished_run import FinishedRun
    from g3r.reuse.other_images import load_images, slices_of
    from g3r.reuse.pose_export import write_slice_folders, write_transforms
    from g3r.reuse.slice_input import images_of_run

    run = FinishedRun.load(options.run)
    measured = None
    if options.stacks:
        measured = slices_of(run.geometry, load_images(run, options.stacks))
    elif options.slices:
        measured = slices_of(run.geometry, images_of_run(run, options.slices))
    try:
        with OutputFolder(options.output) as output, output.result() as folder:
            if options.format == "nesvor":
                n_slices = write_slice_folders(folder, run, measured)
            else:
                n_slices = write_transforms(folder, run, options.format)
    except OSError as error:
        raise cannot_be_written(options.output, error) from None
    return f"{options.output}: {n_slices} slices, {run.space} space"


if __name__ == "__main__":
    sys.exit(main())
