# PYTHON_ARGCOMPLETE_OK
"""`g3r-render`: the volume of a finished run at another resolution, on another grid or in the scanner's space."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from g3r.cli.completion import parsed
from g3r.cli.reuse_options import add_file_options, check_output_file, reuse_parser, told

PROG = "g3r-render"


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = reuse_parser(
        PROG, "Write the volume of a finished run at any resolution or on any grid, without a new fit."
    )
    grid = parser.add_mutually_exclusive_group()
    grid.add_argument("--resolution", type=float, metavar="MM", help="voxel size (default: that of the run)")
    grid.add_argument("--like", metavar="NIFTI", help="an image whose grid is taken; it is in --space")
    parser.add_argument(
        "--space",
        choices=("standard", "scanner"),
        help="of the volume written (default: that of the run); to another one it is moved, not resampled",
    )
    add_file_options(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parsed(build_parser(), argv)
    return told(PROG, lambda: _render(options))


def _render(options: argparse.Namespace) -> str:
    check_output_file(options, [options.like] if options.like else [])
    from g3r.acquisition.images import load_volume, save_volume
    from g3r.reuse.finished_run import FinishedRun
    from g3r.reuse.rendering import render_volume, target_grid

    run = FinishedRun.load(options.run)
    like = load_volume(options.like) if options.like else None
    target = target_grid(run, options.resolution, like, options.space)
    volume = render_volume(run, target.evaluated)
    save_volume(options.output, volume, target.written.affine, space=target.space)
    shape = " x ".join(map(str, target.written.shape))
    spacing = " x ".join(f"{x:.3g}" for x in target.written.spacing_mm)
    return f"{options.output}: {shape} voxels of {spacing} mm, {target.space} space"


if __name__ == "__main__":
    sys.exit(main())
