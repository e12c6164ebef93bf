"""The options of `g3r-infer`, and which of them go together; nothing heavy is imported here."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from g3r._version import __version__
from g3r.cli.dicom_options import add_dicom_output_options, add_input_options, check_dicom_options
from g3r.cli.mask_options import add_mask_options, check_mask_options
from g3r.planning import PRESET_NAMES
from g3r.planning.anatomy import ANATOMIES, FETAL_BRAIN, GENERIC

DEFAULTS = {
    "anatomy": FETAL_BRAIN,
    "preset": "balanced",
    "space": "standard",
    "unseen": "fill",
    "resolution": 0.8,
    "seed": 0,
}
"""Defaults of the options that --config replaces; --no-prior and --time-budget are two more of them."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="g3r-infer",
        description="Reconstruct one isotropic fetal brain volume from stacks of thick slices. "
        "For research only, not for diagnosis.",
        epilog="exit codes: 0 done, 2 usage, 3 bad input or output, 4 numerical failure or out of memory, "
        "130 interrupted",
    )
    add_input_options(parser)
    add_mask_options(parser)
    parser.add_argument(
        "--thickness",
        nargs="+",
        type=float,
        metavar="MM",
        help="slice thickness, one for all or one per stack (default: what the JSON sidecar beside each stack says, or "
        "else the distance of slices)",
    )
    parser.add_argument("--output", required=True, metavar="DIR", help="folder to write")
    add_dicom_output_options(parser)
    parser.add_argument(
        "--ckpt",
        metavar="PRIOR.safetensors",
        help="prior from g3r-export (default: the one shipped), or cc0: shipped weights, of both networks, that were "
        "trained on data in the public domain alone",
    )
    parser.add_argument(
        "--pose-ckpt",
        metavar="POSE.safetensors",
        help="pose network and atlas template from g3r-export, or cc0 (default: shipped, of the set that --ckpt names)",
    )
    parser.add_argument(
        "--space",
        choices=("standard", "scanner"),
        help="standard orientation (RAS, mid-sagittal plane in the middle; the default) or scanner space",
    )
    parser.add_argument(
        "--anatomy",
        choices=ANATOMIES,
        help="fetal-brain (the default), or generic: anything else, with neither atlas, networks nor standard space",
    )
    parser.add_argument(
        "--unseen",
        choices=("fill", "blank"),
        help="what to show of the brain where no slice looked: an estimate (fill, the default) or zeros (blank)",
    )
    parser.add_argument("--no-prior", action="store_true", help="reconstruct without the prior network")
    parser.add_argument("--resolution", type=float, metavar="MM", help="voxel size (default 0.8)")
    parser.add_argument("--preset", choices=PRESET_NAMES, help="speed against accuracy (default: balanced)")
    parser.add_argument(
        "--time-budget",
        type=float,
        metavar="SECONDS",
        help="in place of --preset: the best that can be done from the start of the command to its files",
    )
    parser.add_argument(
        "--config",
        metavar="RUN.json",
        help="settings and threads of an earlier result, in place of the options that decide them",
    )
    parser.add_argument("--seed", type=int, help="of every random choice (default 0)")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads (default: all cores)")
    devices = ("auto", "cpu", "cuda")
    parser.add_argument("--device", choices=devices, default="auto", help="of the networks (default: a GPU if found)")
    parser.add_argument("--max-memory", type=_size, metavar="SIZE", help="as 2G or 1500M; what does not fit is refused")
    parser.add_argument("--tensorboard", metavar="DIR", help="write loss curves and sections for TensorBoard")
    parser.add_argument(
        "--keep-header-text",
        action="store_true",
        help="carry free text of the stacks' headers (may name patients, dates) into the results",
    )
    parser.add_argument("--dry-run", action="store_true", help="check everything and say what would be done")
    parser.add_argument("--force", action="store_true", help="replace an earlier result in --output")
    parser.add_argument(
        "--resume", action="store_true", help="go on from the last finished stage of a run that was cut short"
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("--quiet", action="store_true", help="no progress bars, warnings only")
    return parser


def parsed_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """The options as they hold, defaults filled in; ends the program with 2 where they cannot go together."""
    parser = build_parser()
    options = parser.parse_args(argv)
    check_dicom_options(parser, options)
    n_stacks = len(options.stacks)
    check_mask_options(parser, options)
    if options.thickness is not None and len(options.thickness) not in (1, n_stacks):
        parser.error(f"{len(options.thickness)} thicknesses for {n_stacks} stacks; give one, or one per stack")
    if options.seed is not None and options.seed < 0:
        parser.error(f"--seed {options.seed}; expected 0 or above")
    if options.threads is not None and options.threads < 1:
        parser.error(f"--threads {options.threads}; expected at least 1")
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
    return options


def _check_generic(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with 2 where an option needs what only fetal brains have."""
    named = {f"--{kind}": getattr(options, kind.replace("-", "_")) for kind in ("ckpt", "pose-ckpt", "mask-ckpt")}
    given = [name for name, value in named.items() if value]
    if options.space == "standard":
        given.append("--space standard")
    if given:
        parser.error(f"--anatomy generic and {', '.join(given)} exclude each other: it uses no network and no atlas")
    options.space = "scanner"


def _size(text: str) -> int:
    from g3r.planning.memory_size import parsed_size

    try:
        return parsed_size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
