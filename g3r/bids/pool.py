"""A bounded number of processes at once, which end when the one that started them is asked to stop."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from g3r.bids.executor import Ended, Job, end, ended_with, start
from g3r.run.machine import available_bytes, available_cores

NEEDED_BYTES = 1_500_000_000
"""Of one run of g3r-infer: with fine stacks and the usual presets 1 to 1.5 GB."""

POLL_S = 0.05


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


@dataclass(frozen=True)
class LocalPool:
    """An executor on this machine.

    Args:
        n_jobs: processes at once, at most.
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
                    begin(number)
                    running[number] = start(job), time.monotonic()
                for number, (process, started_s) in list(running.items()):
                    if process.poll() is not None:
                        del running[number]
                        seconds = time.monotonic() - started_s
                        ended(number, ended_with(process.returncode, seconds, "try fewer --jobs"))
                time.sleep(POLL_S)
        finally:
            end([process for process, _ in running.values()])
