"""Job arrays of Slurm, one task per session; submitit writes their scripts and returns how they ended."""

from __future__ import annotations

import math
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import submitit

from g3r.bids.executor import GRACE_S, Ended, Job, end, ended_with, start
from g3r.bids.slurm_queue import GONE, QueueJob, active_among
from g3r.bids.slurm_request import SlurmRequest
from g3r.errors import InputError

LONGEST_ARRAY = 1000
"""Most tasks of an array: Slurm's default limit is 1001. Further tasks follow in another array after its end."""

POLL_S, LONGEST_POLL_S = 1.0, 10.0
"""Seconds between two checks for results: for up to a hundred jobs, and at most."""

LATE_S = 60.0
"""Seconds to wait for a result after Slurm says that its job has ended, because network file systems are slow."""

SIGNAL_BEFORE_S = 90
"""Time of Slurm's signal before the time limit: enough to end a step and write the result so far."""

BESIDE_BYTES = 200_000_000
"""Memory of submitit's process, which waits beside the process of a session."""

SIGNALLED = 128
"""Exit codes above it mean that a signal ended the process."""

TOLD = ("TIMEOUT", "OUT_OF_MEMORY", "CANCELLED")
"""States in which Slurm ends a process; they say more than the exit code."""

MORE_MEMORY = "pass more: --slurm ...,mem=SIZE"


@dataclass(kw_only=True)
class SlurmArrays:
    """An executor on a cluster.

    Args:
        folder: folder for scripts and results of the jobs, on a file system that all nodes share.
        request: resources and options for sbatch.
        n_jobs: tasks at a time; None for as many as Slurm starts.
        n_cores: cores of each task.
        needed_bytes: memory of each task, unless the request states it.
        cluster: submitit's name of the cluster; other values than slurm are for tests.
    """

    folder: Path
    request: SlurmRequest
    n_jobs: int | None
    n_cores: int
    needed_bytes: int
    cluster: str = "slurm"
    begun: str = "goes to Slurm"

    def run_all(self, jobs: Sequence[Job], begin: Callable[[int], None], ended: Callable[[int, Ended], None]) -> None:
        """Run jobs array by array, see `Executor`."""
        self._make_way()
        any_lost = False

        def note(number: int, how: Ended) -> None:
            nonlocal any_lost
            any_lost |= how.code is None
            ended(number, how)

        for first in range(0, len(jobs), LONGEST_ARRAY):
            numbers = range(first, min(first + LONGEST_ARRAY, len(jobs)))
            for number in numbers:
                begin(number)
            self._wait_for(dict(zip(numbers, self._submit([jobs[n] for n in numbers]), strict=True)), note)
        if not any_lost:  # else Slurm's output there is worth a look
            shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):
            self.folder.parent.rmdir()  # only where empty

    def _make_way(self) -> None:
        """Remove files of an earlier run.

        Raises:
            InputError: jobs of the earlier run are not done.
        """
        active = active_among(path.name.split("_")[0] for path in self.folder.glob("*_submitted.pkl"))
        if active:
            raise InputError(
                f"--slurm: job {active[0]} of an earlier run waits or runs; wait for its end, or `scancel "
                f"{' '.join(active)}`, and run this again"
            )
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)

    def _submit(self, jobs: Sequence[Job]) -> list[Any]:
        """Submit an array.

        Raises:
            InputError: Slurm is not installed, or refuses the array.
        """
        said = StringIO()
        try:
            with redirect_stderr(said):  # submitit also prints its error message there
                executor = submitit.AutoExecutor(self.folder, cluster=self.cluster)
                executor.update_parameters(**self._parameters(len(jobs)))
                submitted = executor.map_array(run_job, jobs)
        except RuntimeError as error:  # the class of submitit's errors
            lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
            raise InputError(f"--slurm: no job was taken ({lines[0]}); check the words after --slurm") from None
        if self.cluster != "slurm":
            return submitted
        return [QueueJob(folder=job.paths.folder, job_id=job.job_id) for job in submitted]

    def _parameters(self, n_tasks: int) -> dict[str, Any]:
        """Parameters of an array for submitit and sbatch."""
        mebibytes = math.ceil((self.needed_bytes + BESIDE_BYTES) / 2**20)
        resources = {"cpus-per-task": str(self.n_cores), "mem": f"{mebibytes}M"}
        return {
            "name": "g3r-bids",
            "timeout_min": self.request.minutes,
            "slurm_array_parallelism": self.n_jobs or n_tasks,
            "slurm_signal_delay_s": SIGNAL_BEFORE_S,
            "slurm_srun_args": [f"--cpus-per-task={self.n_cores}"],  # srun no longer takes it from sbatch
            "slurm_additional_parameters": resources | dict(self.request.options),
        }

    def _wait_for(self, running: dict[int, Any], ended: Callable[[int, Ended], None]) -> None:
        """Report jobs as they end; a stop request cancels the remaining ones."""
        over_s: dict[int, float] = {}
        try:
            while running:
                for number, job in list(running.items()):
                    if not job.done():
                        continue
                    over_s.setdefault(number, time.monotonic())
                    how = self._how(job, waits=time.monotonic() - over_s[number] < LATE_S)
                    if how:
                        del running[number]
                        ended(number, how)
                time.sleep(min(LONGEST_POLL_S, POLL_S * max(1.0, len(running) / 100)) if running else 0.0)
        finally:
            self._cancel(list(running.values()))

    def _how(self, job: Any, waits: bool) -> Ended | None:
        """How a job ended; None if its result may still come.

        Args:
            job: submitit's job, which is done.
            waits: whether it ended less than `LATE_S` ago.
        """
        if self.cluster == "slurm" and not job.paths.result_pickle.exists():
            return None if waits and job.state in ("COMPLETED", "FAILED", GONE) else self._lost(job, job.state)
        error = job.exception()
        if error is not None:
            return self._lost(job, "TIMEOUT" if "timed-out" in str(error) else "FAILED")
        how: Ended = job.result()
        if self.cluster == "slurm" and (how.code is None or how.code > SIGNALLED):
            state = job.watcher.get_state(job.job_id, mode="force")
            if state == "RUNNING" and waits:  # Slurm has not yet said why it ended the process
                return None
            return self._lost(job, state) if state in TOLD else how
        return how

    def _lost(self, job: Any, state: str) -> Ended:
        """How a job without a result ended, by its state in Slurm and its output.

        Args:
            job: submitit's job.
            state: its state in Slurm.
        """
        said = (job.stderr() or "").strip()
        if state == "TIMEOUT" or "TIME LIMIT" in said:
            words = f"took longer than {self.request.minutes} min; pass --slurm ...,time=MINUTES"
        elif state == "OUT_OF_MEMORY" or "memory" in said.lower():
            words = f"needed more memory than Slurm gave it; {MORE_MEMORY}"
        elif state == "CANCELLED":
            words = "was cancelled in Slurm"
        else:
            last = said.splitlines()[-1] if said else "it said nothing"
            words = f"was lost by Slurm (state {state}: {last}); {self.folder.name}/ beside the logs of Slurm has more"
        return Ended(lost=f"job {job.job_id} {words}")

    def _cancel(self, jobs: Sequence[Any]) -> None:
        """Cancel jobs, and wait at most `GRACE_S` and `POLL_S` until no process is left."""
        for job in {job.job_id.split("_")[0]: job for job in jobs}.values():
            job.cancel(check=False)
        until_s = time.monotonic() + GRACE_S + POLL_S
        while self.cluster == "slurm" and jobs and time.monotonic() < until_s:
            if not active_among(job.job_id.split("_")[0] for job in jobs):
                return
            time.sleep(POLL_S)


def run_job(job: Job) -> Ended:
    """Run a job on its Slurm node; Slurm's signal before the time limit asks it to stop."""
    began_s = time.monotonic()
    try:
        # Slurm signals all processes of the task; the child ignores it, and this process asks it to stop
        before = signal.signal(signal.SIGUSR2, signal.SIG_IGN)
        try:
            process = start(job)
        finally:
            signal.signal(signal.SIGUSR2, before)
        try:
            code = process.wait()
        finally:
            end([process])
    except OSError as error:
        return Ended(lost=f"the process could not be started ({error})")
    return ended_with(code, time.monotonic() - began_s, MORE_MEMORY)
