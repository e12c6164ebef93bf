"""`g3r-infer`: motion-corrupted stacks in, one volume with maps, poses and a record out."""

from __future__ import annotations

import argparse
import atexit
import gc
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

from g3r.cli.failures import EXPECTED, line_and_code
from g3r.cli.infer_options import parsed_options
from g3r.errors import InputError
from g3r.run.stop_request import StopRequest

if TYPE_CHECKING:
    from g3r.acquisition.stacks import Stack
    from g3r.checkpoints.weights_file import WeightsFile
    from g3r.output.earlier_run import EarlierRun, Inputs
    from g3r.output.result import ReconstructionResult
    from g3r.planning.memory_limit import MemoryPlan
    from g3r.planning.presets import ReconstructionSettings
    from g3r.planning.time_budget import TimeBudget
    from g3r.reconstruct import GaussianReconstructor, Progress

STARTED_S = time.monotonic()
"""When the command began; what Python itself needs before is a few hundredths of a second."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parsed_options(argv)
    logging.basicConfig(
        level=logging.WARNING if options.quiet else logging.INFO, format="g3r-infer: %(message)s", stream=sys.stderr
    )
    for chatty in ("numba", "matplotlib", "PIL"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    atexit.register(gc.freeze)  # the collection of a million objects as Python ends takes a second
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may hold what the terminal cannot show
    stop_request = StopRequest()
    try:
        with stop_request:
            return _run(options, stop_request)
    except KeyboardInterrupt:
        line = f"interrupted; nothing was written{_way_on(Path(options.output))}"
        return _failed(line, stop_request.exit_code)
    except EXPECTED as error:
        return _failed(*line_and_code(error))


def _failed(line: str, exit_code: int) -> int:
    print(f"g3r-infer: {line}", file=sys.stderr)
    return exit_code


def _way_on(folder: Path) -> str:
    from g3r.run.output_folder import OutputFolder

    kept = OutputFolder(folder).stages.is_dir()
    return "; --resume goes on from the last finished stage" if kept else ""


def _run(options: argparse.Namespace, stop_request: StopRequest) -> int:
    from g3r.output.result import OUTPUT_NAMES, check_output_folder, is_partial
    from g3r.run.output_folder import OutputFolder

    folder = Path(options.output)
    replaces = options.force or (options.resume and is_partial(folder))
    weights = _check_files(options, folder, replaces=replaces)  # before any work
    with _lines_held_back():
        earlier = _earlier(options)
        stacks = _load(options, earlier)
        from g3r.output.earlier_run import provenance
        from g3r.planning.memory_limit import plan_for_stacks
        from g3r.reconstruct import GaussianReconstructor
        from g3r.run.stage_store import Stages

        n_threads = _use_threads(options.threads or (earlier.n_threads if earlier else None))
        settings = earlier.settings if earlier else _settings(options)
        reconstructor = GaussianReconstructor(weights.get("prior"), settings, pose_checkpoint=weights.get("pose"))
        inputs = _inputs(options, reconstructor)
        plan = plan_for_stacks(stacks, settings, options.max_memory)
        reconstructor.settings = plan.settings
        budget = _budget(options, earlier)
        if budget and options.resume:
            raise InputError(f"{options.config}: --resume: a run with a time budget keeps no stages; leave it out")
        differences = earlier.differences(inputs) if earlier else []
    for difference in differences:
        logging.getLogger("g3r").warning(difference)
    with _bars(quiet=options.quiet) as progress:
        reconstructor.progress = progress
        if options.dry_run:
            return _dry_run(stacks, plan, folder)
        with OutputFolder(folder, OUTPUT_NAMES) as unfinished:
            check_output_folder(folder, replace=replaces)  # an earlier result may have come back
            thickness = [stack.thickness_mm for stack in stacks]
            told = provenance(settings, inputs, threads=n_threads, thickness=thickness, memory=options.max_memory)
            stages = Stages(None, None if budget else unfinished.stages, told, resume=options.resume)
            result = reconstructor.reconstruct(stacks, budget=budget, stages=stages, stop_request=stop_request)
            result.record["command"] = {
                "stacks": [stack.name for stack in stacks],
                "preset": None if options.time_budget or options.config else options.preset,
                "seed": settings.seed,
                "threads": n_threads,
                "space": "standard" if settings.registration.standard_orientation else "scanner",
            }
            result.record["inputs"] = inputs.record()
            result.record["memory"] = plan.record()
            result.record["notes"] += plan.changes
            result.record["warnings"] += differences
            if options.keep_header_text:
                from g3r.acquisition.header_text import read_header_text

                texts = [read_header_text(path) for path in options.stacks]
                result.record["header_text"] = [text.record() for text in texts]
                result = replace(result, header_text=texts[0])
            result.save(folder, replace=replaces, run=unfinished)
            if not result.record["partial"]:
                unfinished.forget_stages()
    if options.tensorboard:
        from g3r.output.tensorboard import write_tensorboard

        write_tensorboard(Path(options.tensorboard), result.record["loss"], result.volume, result.mask)
    if budget is not None and budget.missed:
        logging.getLogger("g3r").warning(
            "time budget of %g s: took %.0f s; registration, volume and files need at least that here",
            budget.given_s,
            time.monotonic() - STARTED_S,
        )
    _say_what_was_done(result, folder)
    return _said_of_interruption(result, folder, stop_request) if stop_request.is_requested() else 0


def _said_of_interruption(result: ReconstructionResult, folder: Path, stop_request: StopRequest) -> int:
    if result.record["partial"]:
        cut = result.record["interrupted"]
        where = f"interrupted in {cut['stage']}, step {cut['step']} of {cut['n_steps']}"
        line = f"{where}: {folder} holds the volume so far, marked as partial{_way_on(folder)}"
    else:
        line = f"interrupted when the fit had ended: the result in {folder} is whole"
    return _failed(line, stop_request.exit_code)


def _say_what_was_done(result: ReconstructionResult, folder: Path) -> None:
    seconds = sum(result.record["seconds"].values())
    print(f"volume:  {folder / 'volume.nii.gz'}")
    print(f"picture: {folder / 'sections.png'}")
    print(f"poses:   {result.record['registration']['summary']}")
    print(f"{len(result.slices)} slices, {len(result.cloud)} Gaussians, {seconds:.0f} s")


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


def _earlier(options: argparse.Namespace) -> EarlierRun | None:
    if not options.config:
        return None
    from g3r.output.earlier_run import read_run

    earlier = read_run(options.config)
    n_then, n_now = len(earlier.thickness_mm), len(options.stacks)
    if n_then != n_now and not options.thickness:
        raise InputError(f"{options.config}: is of {n_then} stacks, {n_now} are given; pass --thickness to use it")
    return earlier


def _check_files(options: argparse.Namespace, folder: Path, *, replaces: bool) -> dict[str, WeightsFile]:
    """Refuse what can be seen without reading an image; return the files of networks."""
    from g3r.checkpoints.weights_file import read_weights
    from g3r.output.result import check_output_folder

    paths = {"prior": options.ckpt, "pose": options.pose_ckpt}
    networks = {kind: path for kind, path in paths.items() if path}
    check_output_folder(folder, replace=replaces, inputs=[*options.stacks, *(options.masks or ()), *networks.values()])
    if options.tensorboard:
        from g3r.output.tensorboard import check_tensorboard

        check_tensorboard(Path(options.tensorboard))
    return {kind: read_weights(Path(path), kind) for kind, path in networks.items()}


def _load(options: argparse.Namespace, earlier: EarlierRun | None) -> list[Stack]:
    from g3r.acquisition.stacks import load_stacks

    thickness = options.thickness or (list(earlier.thickness_mm) if earlier else None)
    if thickness and len(thickness) == 1:
        thickness = thickness * len(options.stacks)
    return load_stacks(options.stacks, options.masks, thickness)


def _settings(options: argparse.Namespace) -> ReconstructionSettings:
    from g3r.planning.presets import PRESETS

    preset = PRESETS[options.preset]
    if options.time_budget is not None:
        preset = PRESETS["accurate"]  # the most that a budget may take, which is what memory is stated for
    return replace(
        preset,
        registration=replace(preset.registration, standard_orientation=options.space == "standard", seed=options.seed),
        resolution_mm=options.resolution,
        prior_voxel_mm=options.prior_voxel,
        seed=options.seed,
        use_prior=not options.no_prior,
    )


def _inputs(options: argparse.Namespace, reconstructor: GaussianReconstructor) -> Inputs:
    from g3r.output.earlier_run import FileHash, Inputs

    prior, pose = reconstructor.prior, reconstructor.pose_model
    return Inputs(
        tuple(map(FileHash.of, options.stacks)),
        tuple(map(FileHash.of, options.masks or [])),
        FileHash(prior.file_name, prior.file_sha256) if prior else None,
        FileHash(pose.file_name, pose.file_sha256) if pose else None,
    )


def _budget(options: argparse.Namespace, earlier: EarlierRun | None) -> TimeBudget | None:
    """What is left of a time budget that began with the command, or the earlier run's once more."""
    from g3r.planning.time_budget import RepeatedBudget, TimeBudget

    if earlier and earlier.time_budget:
        return RepeatedBudget(earlier.time_budget)
    seconds = options.time_budget
    return None if seconds is None else TimeBudget.of(seconds, time.monotonic() - STARTED_S)


def _use_threads(n: int | None) -> int:
    """Give both thread pools the same number, which is returned; they take turns, stage by stage."""
    import numba
    import torch

    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    wanted = n or min(len(os.sched_getaffinity(0)), most)
    if wanted > most:
        raise InputError(f"--threads {wanted}: this machine offers {most}; choose at most that")
    numba.set_num_threads(wanted)
    torch.set_num_threads(wanted)
    return wanted


def _dry_run(stacks: list[Stack], plan: MemoryPlan, folder: Path) -> int:
    for stack in stacks:
        spacing = " x ".join(f"{x:.2f}" for x in stack.spacing_mm)
        print(
            f"{stack.name}: {'x'.join(map(str, stack.image.shape))} voxels of {spacing} mm, "
            f"thickness {stack.thickness_mm:g} mm, {int(stack.mask.sum())} masked"
        )
    print(plan.estimate.line())
    for change in plan.changes:
        print(change)
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
