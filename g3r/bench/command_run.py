"""One run of `g3r-infer` in a process of its own: seconds, memory and record."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from g3r.errors import InputError, NumericalError
from g3r.evaluation.case import SimulatedCase
from g3r.output.record import RunRecord

PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class CommandRun:
    """A finished run of the command.

    Attributes:
        seconds: wall time from the start to the end of the process, including its files.
        cpu_seconds: CPU time of all its threads.
        peak_bytes: its peak memory.
        record: its run.json.
    """

    seconds: float
    cpu_seconds: float
    peak_bytes: int
    record: RunRecord


def infer_arguments(case: SimulatedCase, preset: str, output: Path) -> list[str]:
    """Arguments of g3r-infer for a simulated subject.

    Args:
        case: simulated subject to reconstruct.
        preset: name of the preset.
        output: folder for the results.
    """
    numbers = range(len(case.stacks))
    return [
        "--stacks",
        *[str(case.folder / f"stack-{n}.nii.gz") for n in numbers],
        "--masks",
        *[str(case.folder / f"mask-{n}.nii.gz") for n in numbers],
        "--thickness",
        *[f"{stack.thickness_mm:g}" for stack in case.stacks],
        "--preset",
        preset,
        "--output",
        str(output),
        "--quiet",
    ]


def run_infer(arguments: Sequence[str], output: Path) -> CommandRun:
    """Run the g3r-infer of this package, and measure the process.

    Args:
        arguments: arguments of g3r-infer, with `output` as `--output`.
        output: folder for the results; an earlier one is removed.

    Raises:
        InputError: g3r-infer refused its input; the message is its own line.
        NumericalError: g3r-infer failed in another way.
    """
    shutil.rmtree(output, ignore_errors=True)
    path = os.pathsep.join(filter(None, [str(PACKAGE_FOLDER), os.environ.get("PYTHONPATH")]))
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-m", "g3r.cli.infer", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert child.stderr is not None
    message = child.stderr.read().decode(errors="replace").strip()  # read until the process ends
    _, status, usage = os.wait4(child.pid, 0)
    seconds = time.perf_counter() - start
    child.stderr.close()
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode == InputError.exit_code:
        raise InputError(message.removeprefix("g3r-infer: "))
    if child.returncode:
        raise NumericalError(f"g3r-infer ended with {child.returncode}: {message[-2000:]}")
    record = RunRecord.read(output / "run.json")
    return CommandRun(seconds, usage.ru_utime + usage.ru_stime, record.peak_memory_bytes, record)
