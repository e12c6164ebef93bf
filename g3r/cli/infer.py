"""`g3r-infer`: motion-corrupted stacks in, one volume with maps, poses and a record out."""

from __future__ import annotations

import argparse
import io
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import TYPE_CHECKING

from g3r.errors import G3RError, InputError

if TYPE_CHECKING:
    from g3r.acquisition.stacks import Stack
    from g3r.budget import TimeBudget
    from g3r.memory import MemoryPlan
    from g3r.presets import ReconstructionSettings
    from g3r.reconstruct import Progress

STARTED_S = time.monotonic()
"""When the command began; what Python itself needs before is a few hundredths of a second."""

PRESET_NAMES = ("draft", "fast", "balanced", "accurate")


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="g3r-infer",
        description="Reconstruct one isotropic fetal brain volume from stacks of thick slices. "
        "For research only, not for diagnosis.",
        epilog="exit codes: 0 done, 2 usage, 3 bad input, 4 numerical failure",
    )
    parser.add_argument("--stacks", nargs="+", required=True, metavar="NIFTI", help="one file per stack")
    parser.add_argument("--masks", nargs="+", metavar="NIFTI", help="brain masks, one per stack, same order")
    parser.add_argument(
        "--thickness", nargs="+", type=float, metavar="MM",
        help="slice thickness, one for all or one per stack (default: the distance of slices)",
    )  # fmt: skip
    parser.add_argument("--output", required=True, metavar="DIR", help="folder to write")
    parser.add_argument("--ckpt", metavar="PRIOR.pt", help="prior from g3r-export (default: the one shipped)")
    parser.add_argument(
        "--pose-ckpt",
        metavar="POSE.pt",
        help="pose network and mean heads from g3r-export (default: shipped)",
    )
    parser.add_argument(
        "--space", choices=("standard", "scanner"), default="standard",
        help="volume in standard orientation (RAS, mid-sagittal plane in the middle) or in scanner space",
    )  # fmt: skip
    parser.add_argument(
        "--prior-voxel", type=float, default=0.8, metavar="MM",
        help="voxel size that the prior was trained on; a --ckpt of another is refused (default 0.8)",
    )  # fmt: skip
    parser.add_argument("--no-prior", action="store_true", help="reconstruct without the prior network")
    parser.add_argument(
        "--resolution", type=float, default=0.8, metavar="MM", help="voxel size (default 0.8)"
    )
    parser.add_argument("--preset", choices=PRESET_NAMES, help="speed against accuracy (default: balanced)")
    parser.add_argument(
        "--time-budget", type=float, metavar="SECONDS",
        help="in place of --preset: the best that can be done from the start of the command to its files",
    )  # fmt: skip
    parser.add_argument("--device", choices=("auto", "cpu"), default="auto", help="where to compute (CPU)")
    parser.add_argument("--seed", type=int, default=0, help="of every random choice")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads (default: all cores)")
    parser.add_argument(
        "--max-memory", type=_size, metavar="SIZE", help="as 2G or 1500M; what does not fit is refused"
    )
    parser.add_argument("--tensorboard", metavar="DIR", help="write loss curves and sections for TensorBoard")
    parser.add_argument(
        "--keep-header-text", action="store_true",
        help="carry free text of the stacks' headers (may name patients, dates) into the results",
    )  # fmt: skip
    parser.add_argument("--dry-run", action="store_true", help="check everything and say what would be done")
    parser.add_argument("--force", action="store_true", help="replace an earlier result in --output")
    parser.add_argument("--quiet", action="store_true", help="no progress bars, warnings only")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parser.parse_args(argv)
    n_stacks = len(options.stacks)
    if options.masks is not None and len(options.masks) != n_stacks:
        parser.error(
            f"{len(options.masks)} masks for {n_stacks} stacks; give one per stack, in the same order"
        )
    if options.thickness is not None and len(options.thickness) not in (1, n_stacks):
        parser.error(
            f"{len(options.thickness)} thicknesses for {n_stacks} stacks; give one, or one per stack"
        )
    if options.seed < 0:
        parser.error(f"--seed {options.seed}; expected 0 or above")
    if options.threads is not None and options.threads < 1:
        parser.error(f"--threads {options.threads}; expected at least 1")
    if options.time_budget is not None and not 0 < options.time_budget < float("inf"):
        parser.error(f"--time-budget {options.time_budget:g}; expected a positive number of seconds")
    if options.time_budget is not None and options.preset:
        parser.error("--preset and --time-budget exclude each other")
    options.preset = options.preset or "balanced"
    if options.ckpt and options.no_prior:
        parser.error("--ckpt and --no-prior exclude each other")
    logging.basicConfig(
        level=logging.WARNING if options.quiet else logging.INFO,
        format="g3r-infer: %(message)s",
        stream=sys.stderr,
    )
    for chatty in ("numba", "matplotlib", "PIL"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may hold what the terminal cannot show
    try:
        return _run(options)
    except G3RError as error:
        print(f"g3r-infer: {error}", file=sys.stderr)
        return error.exit_code
    except MemoryError:
        print(
            "g3r-infer: out of memory; choose a coarser --resolution or --preset draft, or crop the stacks",
            file=sys.stderr,
        )
        return 4
    except KeyboardInterrupt:
        print("g3r-infer: interrupted; nothing was written", file=sys.stderr)
        return 130


def _run(options: argparse.Namespace) -> int:
    folder = Path(options.output)
    _check_files(options, folder)  # before any work
    with _lines_held_back():
        stacks = _load(options)
        from g3r.memory import plan_for_stacks
        from g3r.reconstruct import GaussianReconstructor

        _use_threads(options.threads)
        settings = _settings(options)
        reconstructor = GaussianReconstructor(options.ckpt, settings, pose_checkpoint=options.pose_ckpt)
        plan = plan_for_stacks(stacks, settings, options.max_memory)
        reconstructor.settings = plan.settings
    with _bars(quiet=options.quiet) as progress:
        reconstructor.progress = progress
        if options.dry_run:
            return _dry_run(stacks, plan, folder)
        result = reconstructor.reconstruct(stacks, budget=_budget(options.time_budget))
    result.record["command"] = {
        "stacks": [stack.name for stack in stacks],
        "preset": None if options.time_budget else options.preset, "seed": options.seed,
        "threads": options.threads, "space": options.space,
    }  # fmt: skip
    result.record["memory"] = plan.record()
    result.record["notes"] += plan.changes
    if options.keep_header_text:
        from g3r.acquisition.header_text import read_header_text

        texts = [read_header_text(path) for path in options.stacks]
        result.record["header_text"] = [text.record() for text in texts]
        result = replace(result, header_text=texts[0])
    result.save(folder, replace=options.force)
    if options.tensorboard:
        from g3r.report.tensorboard import write_tensorboard

        write_tensorboard(Path(options.tensorboard), result.record["loss"], result.volume, result.mask)
    seconds = sum(result.record["seconds"].values())
    print(f"volume:  {folder / 'volume.nii.gz'}")
    print(f"picture: {folder / 'sections.png'}")
    print(f"poses:   {result.record['registration']['summary']}")
    print(f"{len(result.slices)} slices, {len(result.cloud)} Gaussians, {seconds:.0f} s")
    return 0


@contextmanager
def _lines_held_back() -> Iterator[None]:
    """Keep log lines until the inputs have proved good, so that a refusal is one line."""
    root = logging.getLogger()
    streams = root.handlers
    held = [MemoryHandler(1000, logging.CRITICAL + 1, stream, flushOnClose=False) for stream in streams]
    root.handlers = list(held)
    try:
        yield
        for handler in held:
            handler.flush()
    finally:
        root.handlers = streams


def _check_files(options: argparse.Namespace, folder: Path) -> None:
    """Refuse what can be seen without reading an image."""
    from g3r.prior.archive import check_archive
    from g3r.result import check_output_folder

    networks = {"prior": options.ckpt, "pose": options.pose_ckpt}
    inputs = [*options.stacks, *(options.masks or ()), *(path for path in networks.values() if path)]
    check_output_folder(folder, replace=options.force, inputs=inputs)
    for kind, path in networks.items():
        if path:
            check_archive(Path(path), kind, "pass a file made by g3r-export, or leave the option out")
    if options.tensorboard:
        from g3r.report.tensorboard import check_tensorboard

        check_tensorboard(Path(options.tensorboard))


def _load(options: argparse.Namespace) -> list[Stack]:
    from g3r.acquisition.stacks import load_stacks

    thickness = options.thickness
    if thickness and len(thickness) == 1:
        thickness = thickness * len(options.stacks)
    return load_stacks(options.stacks, options.masks, thickness)


def _settings(options: argparse.Namespace) -> ReconstructionSettings:
    from g3r.presets import PRESETS

    preset = PRESETS[options.preset]
    if options.time_budget is not None:
        preset = PRESETS["accurate"]  # the most that a budget may take, which is what memory is stated for
    return replace(
        preset,
        motion=replace(preset.motion, standard_orientation=options.space == "standard", seed=options.seed),
        resolution_mm=options.resolution,
        prior_voxel_mm=options.prior_voxel,
        seed=options.seed,
        use_prior=not options.no_prior,
    )


def _budget(seconds: float | None) -> TimeBudget | None:
    """What is left of a time budget that began with the command."""
    from g3r.budget import TimeBudget

    return None if seconds is None else TimeBudget.of(seconds, time.monotonic() - STARTED_S)


def _use_threads(n: int | None) -> None:
    """Give both thread pools the same number; they take turns, stage by stage."""
    import numba
    import torch

    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    wanted = n or min(len(os.sched_getaffinity(0)), most)
    if wanted > most:
        raise InputError(f"--threads {wanted}: this machine offers {most}; choose at most that")
    numba.set_num_threads(wanted)
    torch.set_num_threads(wanted)


def _size(text: str) -> int:
    from g3r.memory import parsed_size

    try:
        return parsed_size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _dry_run(stacks: list[Stack], plan: MemoryPlan, folder: Path) -> int:
    for stack in stacks:
        spacing = " x ".join(f"{x:.2f}" for x in stack.spacing_mm)
        print(
            f"{stack.name}: {'x'.join(map(str, stack.image.shape))} voxels of {spacing} mm, "
            f"thickness {stack.thickness_mm:g} mm, {int(stack.mask.sum())} masked"
        )
    print(plan.estimate.line())
    print(f"would write a volume of {plan.settings.resolution_mm:g} mm to {folder}")
    return 0


@contextmanager
def _bars(*, quiet: bool) -> Iterator[Progress]:
    """A progress bar per stage."""
    if quiet:
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<14}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as bars:
        tasks: dict[str, int] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)  # type: ignore[arg-type]

        yield report


if __name__ == "__main__":
    sys.exit(main())
