"""A pool that runs a limited number of processes at a time, and ends them on a stop request."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from g3r.bids.executor import Ended, Job, end, ended_with, start
from g3r.run.machine import available_bytes, available_cores

NEEDED_BYTES = 1_500_000_000
"""Memory of one run of g3r-infer; with fine stacks and the usual presets it takes 1 to 1.5 GB."""

POLL_S = 0.05


def default_jobs(needed_bytes: int = NEEDED_BYTES) -> int:
    """Number of processes for this machine: half its cores, and no more than fit into free memory; at least one.

    Args:
        needed_bytes: memory of each process.
    """
    return max(1, min(available_cores() // 2, available_bytes() // needed_bytes))


def threads_each(n_jobs: int) -> int:
    """Threads for each process: its share of the cores, and at most NUMBA_NUM_THREADS."""
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    share = max(1, available_cores() // n_jobs)
    return min(share, int(limit)) if limit.isdigit() and int(limit) else share


@dataclass(frozen=True)
class LocalPool:
    """An executor on this machine.

    Args:
        n_jobs: largest number of processes at a time.
    """

    n_jobs: int
    begun: str = "started"

    def run_all(self, jobs: Sequence[Job], begin: Callable[[int], None], ended: Callable[[int, Ended], None]) -> None:
        """Run jobs in order, see `Executor`."""
        waiting = list(enumerate(jobs))
        running: dict[int, tuple[subprocess.Popen[bytes], float]] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.n_jobs:
                    number, job = waiting.pop(0)
                    try:
                        begin(number)
                        running[number] = start(job), time.monotonic()
                    except OSError as error:
                        ended(number, Ended(lost=f"its process could not be started ({error})"))
                for number, (process, started_s) in list(running.items()):
                    if process.poll() is not None:
                        del running[number]
                        seconds = time.monotonic() - started_s
                        ended(number, ended_with(process.returncode, seconds, "try fewer --jobs"))
                time.sleep(POLL_S)
        finally:
            end([process for process, _ in running.values()])
