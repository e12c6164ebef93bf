# PYTHON_ARGCOMPLETE_OK
"""`g3r-infer`: reconstruct one volume, with maps, poses and a record, from motion-corrupted stacks."""

from __future__ import annotations

import argparse
import atexit
import gc
import logging
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from g3r._version import __version__
from g3r.cli.dicom_options import stacks_on_disk, write_dicom
from g3r.cli.failures import fail, run_command
from g3r.cli.infer_options import parsed_options, told_options, without_names
from g3r.cli.infer_task import STARTED_S, Task, check_files, earlier_run, prepared
from g3r.cli.interruption import ended_behind, ended_in_order, nothing_written
from g3r.cli.terminal import PROGRAM, Terminal
from g3r.cli.time_left import TimeLeft, expected_seconds
from g3r.report.stage_words import WRITING
from g3r.run.ahead import import_ahead
from g3r.run.idle_threads import let_threads_sleep
from g3r.run.kernel_cache import needs_compiling
from g3r.run.lean_import import import_lean, load_nibabel
from g3r.run.log_file import LOG_NAME, LogFile
from g3r.run.stop_request import StopRequest

if TYPE_CHECKING:
    from g3r.output.result import ReconstructionResult
    from g3r.planning.plan import Plan
    from g3r.run.output_folder import OutputFolder
    from g3r.run.reporter import Reporter
    from g3r.run.stage_store import StageStore

NEEDED_LATER = ("SimpleITK", "g3r.output.sections", "g3r.output.mask_picture", "g3r.report.page")
"""Modules that take a few tenths of a second to import: imported while registration runs and holds no lock."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parsed_options(argv)
    import_lean()
    let_threads_sleep()
    atexit.register(gc.freeze)  # the collection of a million objects as Python ends takes a second
    stop_request = StopRequest()

    def work() -> int:
        with stop_request, _terminal(options, stop_request) as terminal:
            return _run(options, stop_request, terminal)

    return run_command(
        PROGRAM, work, interrupted=lambda: (nothing_written(Path(options.output)), stop_request.exit_code)
    )


def _terminal(options: argparse.Namespace, stop_request: StopRequest) -> Terminal:
    """The terminal of this run, with its expected duration."""
    compiling = needs_compiling() and not options.dry_run
    expected_s, compiled_s = (expected_seconds(options, compiling=one) for one in (compiling, False))
    log = LogFile(*without_names(options))
    log.say(f"{PROGRAM} {__version__}, Python {platform.python_version()}, {platform.system()}, {os.cpu_count()} cores")
    log.say(f"options: {told_options(options)}")
    compiling_s = sum(expected_s.values()) - sum(compiled_s.values())
    return Terminal(
        TimeLeft(expected_s),
        log,
        quiet=options.quiet,
        verbose=options.verbose,
        compiling_s=compiling_s,
        stop_request=stop_request,
    )


def _run(options: argparse.Namespace, stop_request: StopRequest, terminal: Terminal) -> int:
    from g3r.output.files import OUTPUT_NAMES
    from g3r.run.output_folder import OutputFolder

    folder = Path(options.output)
    replaces = options.force or (options.resume and _is_partial(folder))
    load_nibabel()
    with terminal.held_back():
        with stacks_on_disk(options, replaces=replaces) as dicom:
            earlier = earlier_run(options)
            networks = check_files(options, folder, replaces=replaces)  # before any image is read
            task = prepared(options, networks, earlier, terminal)
        for name, facts in task.told():
            terminal.tell(name, facts)
    task = replace(task, warnings=dicom.warnings + task.warnings, notes=dicom.notes)
    for warning in task.warnings:
        logging.getLogger("g3r").warning(warning)
    if options.dry_run:
        terminal.end_bar()
        return _dry_run(task, folder)
    output = OutputFolder(folder, OUTPUT_NAMES)
    try:
        result = _reconstructed(options, task, output, stop_request, terminal, replaces=replaces)
        _warn_of_missed_budget(task.plan)
        write_dicom(options, result, dicom)
        terminal.end_bar()
        stopped = stop_request.is_requested()
        code = fail(PROGRAM, ended_in_order(result, folder), stop_request.exit_code) if stopped else 0
        _conclude(result, folder, terminal)
    except KeyboardInterrupt:  # a second signal, which raises at once
        if not output.is_written:
            raise
        terminal.end_bar()
        return fail(PROGRAM, ended_behind(folder, options.dicom_out), stop_request.exit_code)
    return code


def _reconstructed(
    options: argparse.Namespace,
    task: Task,
    output: OutputFolder,
    stop_request: StopRequest,
    terminal: Terminal,
    *,
    replaces: bool,
) -> ReconstructionResult:
    """Run the reconstruction and write its folder."""
    from g3r.output.files import OUTPUT_NAMES
    from g3r.run.context import RunContext
    from g3r.run.output_folder import check_output_folder

    folder = output.named
    with output, _logged(output, terminal.log), _reporter(options, task, terminal) as reporter:
        check_output_folder(folder, OUTPUT_NAMES, replace=replaces)  # an earlier result may have come back
        import_ahead(*NEEDED_LATER)
        run = RunContext(store=_store(options, task, output.stages), stop_request=stop_request, reporter=reporter)
        poses = task.slices.poses if task.slices else None
        result: ReconstructionResult = task.reconstructor.reconstruct(task.stacks, poses, plan=task.plan, run=run)
        run.postpone_stop()  # a volume without a fit is worth keeping, too
        result = _with_command(result, options, task)
        terminal.begun(WRITING)

        def also(staged: Path) -> None:
            terminal.tell("written", {})
            terminal.log.copy_to(staged)

        result.save(folder, replace=replaces, run=output, also=also)
        terminal.log.go_on_in(folder)
        if not result.record.partial:
            output.forget_stages()
    return result


@contextmanager
def _logged(output: OutputFolder, log: LogFile) -> Iterator[None]:
    """Keep the log beside the stages until there is a result; a failure is logged with its trace."""
    log.keep_in(output.staging)
    try:
        yield
    except BaseException:
        logging.getLogger("g3r").debug("the run failed", exc_info=True)
        raise


@contextmanager
def _reporter(options: argparse.Namespace, task: Task, terminal: Terminal) -> Iterator[Reporter]:
    """Reporters of the stages: the terminal, and TensorBoard if asked for."""
    if not options.tensorboard:
        yield terminal
        return
    from g3r.output.live_board import LiveBoard
    from g3r.run.reporter import Reporters

    with LiveBoard(Path(options.tensorboard)) as board:
        task.reconstructor.observer = board
        yield Reporters([terminal, board])


def _store(options: argparse.Namespace, task: Task, folder: Path) -> StageStore:
    """The stage store; it keeps nothing under a time budget, whose choices depend on the clock."""
    from g3r.output.stored_records import STORED_RECORDS
    from g3r.planning.plan import FixedPlan
    from g3r.run.provenance import provenance
    from g3r.run.stage_store import StageStore

    if type(task.plan) is not FixedPlan:
        return StageStore()
    made_of = provenance(
        task.settings,
        task.inputs.named(),
        threads=task.n_threads,
        device=task.reconstructor.networks.device,
        thickness=[stack.thickness_mm for stack in task.stacks],
        in_plane_fwhm_pixels=[stack.in_plane_fwhm_pixels for stack in task.stacks],
        memory=options.max_memory,
    )
    return StageStore(folder, made_of, STORED_RECORDS, resume=options.resume)


def _with_command(result: ReconstructionResult, options: argparse.Namespace, task: Task) -> ReconstructionResult:
    """The result with the command's own facts added to its record."""
    from g3r.acquisition.header_text import read_header_text
    from g3r.output.record import CommandRecord

    texts = [read_header_text(path) for path in options.stacks] if options.keep_header_text else []
    command = CommandRecord(
        stacks=[stack.name for stack in task.stacks],
        preset=None if options.time_budget or options.config else options.preset,
        seed=task.settings.seed,
        threads=task.n_threads,
        device=task.reconstructor.networks.device,
        space="standard" if task.settings.registration.standard_orientation else "scanner",
    )
    record = replace(
        result.record,
        command=command,
        # a short time budget leaves the network out that was loaded
        inputs=task.inputs if result.record.prior else replace(task.inputs, prior=None),
        memory=task.memory.record(),
        notes=task.notes + result.record.notes + task.memory.changes,
        warnings=result.record.warnings + task.warnings,
        header_text=[text.record() for text in texts] or None,
    )
    return replace(result, record=record, header_text=texts[0] if texts else None)


def _conclude(result: ReconstructionResult, folder: Path, terminal: Terminal) -> None:
    """Print the files to look at, and last the verdict."""
    from g3r.output.files import MASK_PICTURE, REPORT_NAME
    from g3r.report.verdict import verdict_of

    lines = [f"volume:  {folder / 'volume.nii.gz'}", f"picture: {folder / 'sections.png'}"]
    if (folder / REPORT_NAME).is_file():
        lines.append(f"report:  {folder / REPORT_NAME}")
    found = sorted({stack.mask_from for stack in result.record.stacks} - {"file"})
    if found:
        lines.append(f"masks:   {' and '.join(found)}: look at {folder / MASK_PICTURE}")
    lines.append(f"details: {folder / LOG_NAME}")
    verdict = verdict_of(result.record)
    terminal.conclude(lines, verdict.word, f"verdict: {verdict.line()}")


def _warn_of_missed_budget(plan: Plan) -> None:
    from g3r.planning.time_budget import TimeBudget

    if isinstance(plan, TimeBudget) and plan.missed:
        logging.getLogger("g3r").warning(
            "time budget of %g s: took %.0f s; registration, volume and files need at least that here",
            plan.given_s,
            time.monotonic() - STARTED_S,
        )


def _is_partial(folder: Path) -> bool:
    from g3r.output.result import is_partial

    return is_partial(folder)


def _dry_run(task: Task, folder: Path) -> int:
    for stack in task.stacks:
        spacing = " x ".join(f"{x:.2f}" for x in stack.spacing_mm)
        print(
            f"{stack.name}: {'x'.join(map(str, stack.image.shape))} voxels of {spacing} mm, "
            f"thickness {stack.thickness_mm:g} mm ({stack.origin.thickness_from}), {int(stack.mask.sum())} masked"
        )
    print(task.memory.estimate.line())
    for change in task.memory.changes:
        print(change)
    print(f"would write a volume of {task.settings.resolution_mm:g} mm to {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
