"""Slurm jobs of submitit with their states from squeue.

submitit asks sacct, which needs an accounting data base that not every cluster has; without it a killed job would
seem to run for ever. squeue still lists a job for some minutes after its end.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterable
from contextlib import suppress

from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

GONE = "GONE"
"""State of a job that squeue no longer lists."""

LIST = ("squeue", "--noheader", "--array", "--states=all", "--format=%i|%T")

ACTIVE = {"PENDING", "CONFIGURING", "RUNNING", "COMPLETING", "REQUEUED", "REQUEUE_HOLD", "SUSPENDED", "RESIZING"}

LONGEST_WAIT_S = 30
"""Longest time between two calls of squeue; the first calls follow each other faster."""


class QueueWatcher(SlurmInfoWatcher):
    """Reads the states of all jobs by one call of squeue."""

    def _make_command(self) -> list[str] | None:
        waited_for = self._registered - self._finished
        return [*LIST, f"--user={os.getuid()}"] if waited_for else None

    def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
        """States of the jobs under watch, from the output of squeue."""
        states = _states(string if isinstance(string, str) else string.decode(errors="replace"))
        return {job_id: {"State": states.get(job_id, GONE)} for job_id in self._registered - self._finished}

    def get_state(self, job_id: str, mode: str = "standard") -> str:
        """The state of a job, see `SlurmInfoWatcher`."""
        state = self.get_info(job_id, mode=mode).get("State", "UNKNOWN")
        return "RUNNING" if state in ACTIVE else state


class QueueJob(SlurmJob):
    """A job, or one task of an array."""

    watcher = QueueWatcher(delay_s=LONGEST_WAIT_S)

    def done(self, force_check: bool = False) -> bool:
        """Whether its result is there, or Slurm says that it has ended; the check writes nothing."""
        return self.paths.result_pickle.exists() or self.watcher.is_done(self.job_id)

    def cancel(self, check: bool = True) -> None:
        """Cancel all tasks of its array."""
        del check
        with suppress(OSError):
            subprocess.call(["scancel", self.job_id.split("_")[0]])


def active_among(array_ids: Iterable[str]) -> list[str]:
    """Ids of the given jobs and arrays that are still active; none if squeue cannot be asked."""
    try:
        said = subprocess.run(
            [*LIST, f"--user={os.getuid()}"], capture_output=True, text=True, check=True, timeout=60
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    active = {job_id.split("_")[0] for job_id, state in _states(said).items() if state in ACTIVE}
    return sorted(active.intersection(array_ids))


def _states(text: str) -> dict[str, str]:
    """States by job, from the output of squeue."""
    return dict(line.strip().split("|", 1) for line in text.splitlines() if "|" in line)
