# PYTHON_ARGCOMPLETE_OK
"""`g3r-apply`: volumes of other echoes, contrasts or label maps of the same slices, in the poses of a finished run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from g3r.cli.completion import parsed
from g3r.cli.reuse_options import add_file_options, check_output_file, reuse_parser, told

PROG = "g3r-apply"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = reuse_parser(PROG, "Make a volume of other images of the same slices, in the poses that a run found.")
    images = parser.add_mutually_exclusive_group(required=True)
    images.add_argument(
        "--stacks",
        nargs="+",
        metavar="NIFTI",
        help="another echo or contrast of each stack of the run, in the run's order and on the same grids",
    )
    images.add_argument(
        "--labels", nargs="+", metavar="NIFTI", help="a label map of each stack; voxels take the label with most votes"
    )
    parser.add_argument(
        "--no-gain",
        action="store_true",
        help="do not divide the run's intensity factors out of --stacks (for quantitative maps)",
    )
    add_file_options(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parsed(parser, argv)
    if options.no_gain and options.labels:
        parser.error("--no-gain and --labels exclude each other: labels have no gain")
    return told(PROG, lambda: _apply(options))


def _apply(options: argparse.Namespace) -> str:
    paths = options.stacks or options.labels
    check_output_file(options, paths)
    from g3r.acquisition.images import save_volume
    from g3r.reuse.finished_run import FinishedRun
    from g3r.reuse.other_images import fuse_labels, load_images, reconstruct_images

    run = FinishedRun.load(options.run)
    images = load_images(run, paths)
    affine = run.geometry.grid.affine
    if options.labels:
        save_volume(options.output, fuse_labels(run, images), affine, space=run.space)
    else:
        volume = reconstruct_images(run, images, with_gain=not options.no_gain)
        save_volume(options.output, volume, affine, space=run.space)
    what = "labels" if options.labels else "volume"
    return f"{options.output}: {what} of {len(run.geometry.slices)} slices, on the grid of {run.folder}/volume.nii.gz"


if __name__ == "__main__":
    sys.exit(main())
