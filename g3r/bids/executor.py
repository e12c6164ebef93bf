"""One process for each session, and what may run them: the pool of this machine, or arrays of Slurm."""

from __future__ import annotations

import os
import shlex
import subprocess
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from g3r.run.hidden_folders import name_alone

GRACE_S = 30.0
"""For a run that is asked to stop to end its step and write what it has."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A process to run.

    Attributes:
        words: its command line.
        log: file for what it says.
    """

    words: tuple[str, ...]
    log: Path


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a process ended.

    Attributes:
        code: that it returned; None where it was ended from outside.
        lost: what ended it, in one line; empty where it returned.
        seconds: that it took; None where nobody could tell.
    """

    code: int | None = None
    lost: str = ""
    seconds: float | None = None


class Executor(Protocol):
    """Runs processes, some of them at once."""

    @property
    def begun(self) -> str:
        """What is said of a job that it takes."""

    def run_all(self, jobs: Sequence[Job], begin: Callable[[int], None], ended: Callable[[int, Ended], None]) -> None:
        """Run jobs in order until all have ended.

        Args:
            jobs: to run.
            begin: called with the number of a job just before it is taken.
            ended: called with the number of a job and how it ended.

        Raises:
            KeyboardInterrupt: a stop was requested; no process is left.
            InputError: jobs cannot be run in this way.
        """


def start(job: Job) -> subprocess.Popen[bytes]:
    """Start the process of a job; its command line, with names of files alone, and its output go to its log.

    Raises:
        OSError: the log cannot be written, or there is no such command.
    """
    with job.log.open("wb") as log:
        log.write(f"{shlex.join(map(name_alone, job.words))}\n".encode(errors="surrogateescape"))
        log.flush()
        return subprocess.Popen(
            job.words,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            start_new_session=True,  # Ctrl-C comes from us, once: a second one would end it without a trace
        )


def end(processes: Collection[subprocess.Popen[bytes]]) -> None:
    """Ask processes to stop, and kill those that do not; a second request to stop kills at once."""
    for process in processes:
        process.terminate()
    until_s = time.monotonic() + GRACE_S
    with suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
        for process in processes:
            process.wait(max(0.0, until_s - time.monotonic()))
    for process in processes:
        process.kill()
        process.wait()


def ended_with(code: int, seconds: float, remedy: str) -> Ended:
    """How a process ended, by what the system says of it.

    Args:
        code: exit code; below zero the signal that ended it.
        seconds: that it took.
        remedy: what to do where it lacked memory.
    """
    if code >= 0:
        return Ended(code=code, seconds=seconds)
    lost = f"g3r-infer was ended by signal {-code} (9: perhaps for lack of memory; {remedy})"
    return Ended(lost=lost, seconds=seconds)
