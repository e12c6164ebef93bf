"""The options of `g3r-infer`, and their valid combinations; nothing heavy is imported here."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

from g3r._version import __version__
from g3r.cli.completion import HelpFormatter, parsed
from g3r.cli.dicom_options import add_dicom_output_options, add_input_options, check_dicom_options
from g3r.cli.mask_options import add_mask_options, check_mask_options, check_threads
from g3r.cli.slice_options import add_slice_options, check_slice_options
from g3r.planning import PRESET_NAMES
from g3r.planning.anatomy import ANATOMIES, FETAL_BRAIN, GENERIC

DEFAULTS = {
    "anatomy": FETAL_BRAIN,
    "preset": "balanced",
    "space": "standard",
    "unseen": "fill",
    "misfits": "leave-out",
    "resolution": 0.8,
    "seed": 0,
}
"""Defaults of the options that --config replaces; it also replaces --no-prior and --time-budget."""

USAGE = """%(prog)s --stacks NIFTI [NIFTI ...] --output DIR [options]
       %(prog)s --dicom DIR --output DIR [options]
       %(prog)s --slices DIR --output DIR [options]"""

DESCRIPTION = """\
Reconstruct one isotropic fetal brain volume from stacks of thick slices.
For research only, not for diagnosis."""

EPILOG = """\
examples:
  three stacks; the brain is found, thickness is read from files beside them:
    g3r-infer --stacks ax.nii.gz cor.nii.gz sag.nii.gz --output out

  with brain masks, slices of 3 mm, as quick as can be:
    g3r-infer --stacks ax.nii cor.nii --masks ax-mask.nii cor-mask.nii \\
              --thickness 3 --preset preview --output out

  an examination as the scanner sent it; what would be used is only listed:
    g3r-infer --dicom examination --output out --dry-run

Look at out/report.html first. The last line says: use, check, or do not use.
exit codes: 0 done, 2 usage, 3 bad input or output, 4 numerical failure or out
of memory, 130 interrupted (Ctrl-C; --resume goes on)"""


def build_parser() -> argparse.ArgumentParser:
    """The command's options, in groups."""
    parser = argparse.ArgumentParser(
        prog="g3r-infer",
        usage=USAGE,
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
        add_help=False,
    )
    _add_input(parser)
    _add_result(parser)
    _add_effort(parser)
    _add_networks(parser)
    _add_saying(parser)
    return parser


def _add_input(parser: argparse.ArgumentParser) -> None:
    stacks = parser.add_argument_group("stacks")
    add_input_options(stacks)
    add_slice_options(stacks)
    stacks.add_argument(
        "--thickness",
        nargs="+",
        type=float,
        metavar="MM",
        help="slice thickness, one for all or one per stack (default: what the JSON sidecar beside each stack says, or "
        "else the distance of slices; with --slices, what their headers say)",
    )
    add_mask_options(parser.add_argument_group("what is brain"))


def _add_result(parser: argparse.ArgumentParser) -> None:
    result = parser.add_argument_group("result")
    result.add_argument("--output", required=True, metavar="DIR", help="folder to write")
    result.add_argument("--force", action="store_true", help="replace an earlier result in --output")
    result.add_argument(
        "--resume", action="store_true", help="go on from the last finished stage of a run that was cut short"
    )
    result.add_argument("--resolution", type=float, metavar="MM", help="voxel size (default: 0.8)")
    result.add_argument(
        "--space",
        choices=("standard", "scanner"),
        help="standard orientation (RAS, mid-sagittal plane in the middle) or scanner space (default: standard)",
    )
    result.add_argument(
        "--anatomy",
        choices=ANATOMIES,
        help="fetal-brain, or generic: anything else, with neither atlas, networks nor standard space (default: "
        "fetal-brain)",
    )
    result.add_argument(
        "--unseen",
        choices=("fill", "blank"),
        help="what to show of the brain where no slice looked: an estimate, or zeros (default: fill)",
    )
    result.add_argument(
        "--misfits",
        choices=("leave-out", "keep"),
        help="stacks that do not fit the others, where most do (default: leave-out; --preset preview keeps them)",
    )
    result.add_argument(
        "--keep-header-text",
        action="store_true",
        help="carry free text of the stacks' headers (may name patients, dates) into the results (default: leave out)",
    )
    add_dicom_output_options(result)


def _add_effort(parser: argparse.ArgumentParser) -> None:
    effort = parser.add_argument_group("speed against accuracy")
    effort.add_argument(
        "--preset", choices=PRESET_NAMES, help="from quick to thorough (default: balanced, about half a minute)"
    )
    effort.add_argument(
        "--time-budget",
        type=float,
        metavar="SECONDS",
        help="in place of --preset: the best that can be done from the start of the command to its files",
    )
    effort.add_argument(
        "--config",
        metavar="RUN.json",
        help="settings and threads of an earlier result, in place of the options that decide them",
    )
    effort.add_argument("--seed", type=int, metavar="N", help="of every random choice (default: 0)")
    effort.add_argument("--threads", type=int, metavar="N", help="CPU threads (default: all cores)")
    devices = ("auto", "cpu", "cuda")
    effort.add_argument(
        "--device", choices=devices, default="auto", help="of the networks (default: auto, a GPU if found)"
    )
    effort.add_argument(
        "--max-memory",
        type=_size,
        metavar="SIZE",
        help="as 2G or 1500M: plan with less, or refuse what does not fit (default: no limit; a warning where more "
        "is needed than is free)",
    )


def _add_networks(parser: argparse.ArgumentParser) -> None:
    networks = parser.add_argument_group("networks")
    networks.add_argument("--no-prior", action="store_true", help="reconstruct without the prior network")
    networks.add_argument(
        "--ckpt",
        metavar="PRIOR.safetensors",
        help="prior from g3r-export, or cc0: shipped weights, of both networks, that were trained on data in the "
        "public domain alone (default: the one shipped)",
    )
    networks.add_argument(
        "--pose-ckpt",
        metavar="POSE.safetensors",
        help="pose network and atlas template from g3r-export, or cc0 (default: shipped, of the set that --ckpt names)",
    )


def _add_saying(parser: argparse.ArgumentParser) -> None:
    saying = parser.add_argument_group("what is said")
    saying.add_argument("--dry-run", action="store_true", help="check everything and say what would be done")
    how_much = saying.add_mutually_exclusive_group()
    how_much.add_argument("--quiet", action="store_true", help="no bar and no stages: warnings and the result only")
    how_much.add_argument(
        "--verbose", action="store_true", help="developers' detail, too (log.txt in the output always has it)"
    )
    saying.add_argument(
        "--tensorboard", metavar="DIR", help="write losses, poses and sections while the fit runs, for TensorBoard"
    )
    saying.add_argument("--version", action="version", version=f"%(prog)s {__version__}", help="say it and end")
    saying.add_argument("-h", "--help", action="help", help="say this and end")


def parsed_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """The parsed options with defaults; ends the program with 2 if they cannot be combined."""
    parser = build_parser()
    options = parsed(parser, argv)
    check_slice_options(parser, options)
    check_dicom_options(parser, options)
    n_stacks = len(options.stacks)
    check_mask_options(parser, options)
    if options.thickness is not None and not options.slices and len(options.thickness) not in (1, n_stacks):
        parser.error(f"{len(options.thickness)} thicknesses for {n_stacks} stacks; give one, or one per stack")
    if options.seed is not None and options.seed < 0:
        parser.error(f"--seed {options.seed}; expected 0 or above")
    check_threads(parser, options)
    if options.time_budget is not None and not 0 < options.time_budget < float("inf"):
        parser.error(f"--time-budget {options.time_budget:g}; expected a positive number of seconds")
    if options.time_budget is not None and options.preset:
        parser.error("--preset and --time-budget exclude each other")
    if options.resume and options.time_budget is not None:
        parser.error("--resume and --time-budget exclude each other: such a run keeps no stages")
    if options.config:
        decided = [name for name in (*DEFAULTS, "time_budget") if getattr(options, name) is not None]
        decided += ["no_prior"] if options.no_prior else []
        if decided:
            named = ", ".join(f"--{name.replace('_', '-')}" for name in decided)
            parser.error(f"--config and {named} exclude each other: the file decides that")
    if options.anatomy == GENERIC:
        _check_generic(parser, options)
    for name, value in DEFAULTS.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    if options.ckpt and options.no_prior:
        parser.error("--ckpt and --no-prior exclude each other")
    if options.preset == "preview" and options.ckpt and not _names_a_set(options.ckpt):
        parser.error("--ckpt and --preset preview exclude each other: a preview uses no prior network")
    return options


def _names_a_set(weights: str) -> bool:
    from g3r.checkpoints.shipped import set_of

    return set_of(weights) is not None


def _check_generic(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 if an option needs networks or atlas, which exist only for fetal brains."""
    named = {f"--{kind}": getattr(options, kind.replace("-", "_")) for kind in ("ckpt", "pose-ckpt", "mask-ckpt")}
    given = [name for name, value in named.items() if value]
    if options.space == "standard":
        given.append("--space standard")
    if given:
        parser.error(f"--anatomy generic and {', '.join(given)} exclude each other: it uses no network and no atlas")
    options.space = "scanner"


PATHS = ("stacks", "masks", "config", "ckpt", "pose_ckpt", "mask_ckpt")
FOLDERS = ("output", "dicom", "slices", "dicom_out", "dicom_reference", "tensorboard")
"""Options that name files, and options that name folders."""


def without_names(options: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Paths to hide from the log: files, whose folders are hidden, and folders."""
    given = [getattr(options, name) for name in PATHS]
    files = [one for value in given if value for one in ([value] if isinstance(value, str) else value)]
    folders = [str(value) for name in FOLDERS if (value := getattr(options, name))]
    return files, [*folders, *map(os.path.dirname, folders)]


def told_options(options: argparse.Namespace) -> str:
    """The given options, for the log: files by name only, without folders and commands."""
    told = []
    for name, value in vars(options).items():
        if value in (None, False) or name in (*FOLDERS, "mask_command"):
            continue
        values = value if isinstance(value, list) else [value]
        words = [os.path.basename(str(one)) if name in PATHS else str(one) for one in values]
        told.append(" ".join([f"--{name.replace('_', '-')}", *([] if value is True else words)]))
    return " ".join(told)


def _size(text: str) -> int:
    from g3r.planning.memory_size import parsed_size

    try:
        return parsed_size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
