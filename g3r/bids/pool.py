"""A bounded number of processes at once, which end when the one that started them is asked to stop."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress

from g3r.run.machine import available_bytes, available_cores

NEEDED_BYTES = 1_500_000_000
"""Of one run of g3r-infer: with fine stacks and the usual presets 1 to 1.5 GB."""

POLL_S = 0.05

GRACE_S = 30.0
"""For a run that is asked to stop to end its step and write what it has."""

Start = Callable[[], subprocess.Popen[bytes]]


def default_jobs(needed_bytes: int = NEEDED_BYTES) -> int:
    """Processes for this machine: half its cores, and no more than memory is free for; at least one.

    Args:
        needed_bytes: of each process.
    """
    return max(1, min(available_cores() // 2, available_bytes() // needed_bytes))


def threads_each(n_jobs: int) -> int:
    """Threads for each of some processes: its share of the cores, and no more than numba's environment allows."""
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    share = max(1, available_cores() // n_jobs)
    return min(share, int(limit)) if limit.isdigit() and int(limit) else share


def run_all(starts: Sequence[Start], ended: Callable[[int, int], None], n_jobs: int) -> None:
    """Start processes in order, some of them at once, until all have ended.

    Args:
        starts: start one process each.
        ended: called with the number of a process and its exit code.
        n_jobs: that run at once, at most.

    Raises:
        KeyboardInterrupt: a stop was requested; no process is left.
    """
    waiting = list(enumerate(starts))
    running: dict[int, subprocess.Popen[bytes]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < n_jobs:
                number, start = waiting.pop(0)
                running[number] = start()
            for number, process in list(running.items()):
                if process.poll() is not None:
                    del running[number]
                    ended(number, process.returncode)
            time.sleep(POLL_S)
    finally:
        _end(running.values())


def _end(processes: Collection[subprocess.Popen[bytes]]) -> None:
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
