"""Jobs of Slurm as submitit has them, with their states by squeue.

submitit asks sacct, which needs an accounting data base that not every cluster has; without it a job that was killed
would seem to run for ever. squeue still lists a job for some minutes after its end.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterable
from contextlib import suppress

from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

GONE = "GONE"
"""State of a job that squeue does not know any more."""

LIST = ("squeue", "--noheader", "--array", "--states=all", "--format=%i|%T")

ACTIVE = {"PENDING", "CONFIGURING", "RUNNING", "COMPLETING", "REQUEUED", "REQUEUE_HOLD", "SUSPENDED", "RESIZING"}

LONGEST_WAIT_S = 30
"""Between two calls of squeue; the first ones follow each other more closely."""


class QueueWatcher(SlurmInfoWatcher):
    """States of all jobs by one call."""

    def _make_command(self) -> list[str] | None:
        waited_for = self._registered - self._finished
        return [*LIST, f"--user={os.getuid()}"] if waited_for else None

    def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
        """States of the jobs that are waited for, by what squeue printed."""
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
        """Whether its result is there or Slurm says that it has ended; nothing is written to look."""
        return self.paths.result_pickle.exists() or self.watcher.is_done(self.job_id)

    def cancel(self, check: bool = True) -> None:
        """Cancel all tasks of its array."""
        del check
        with suppress(OSError):
            subprocess.call(["scancel", self.job_id.split("_")[0]])


def active_among(array_ids: Iterable[str]) -> list[str]:
    """Those of some jobs and arrays that Slurm has not ended yet; none where it cannot be asked."""
    try:
        said = subprocess.run(
            [*LIST, f"--user={os.getuid()}"], capture_output=True, text=True, check=True, timeout=60
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    active = {job_id.split("_")[0] for job_id, state in _states(said).items() if state in ACTIVE}
    return sorted(active.intersection(array_ids))


def _states(text: str) -> dict[str, str]:
    """States by job in what squeue printed."""
    return dict(line.strip().split("|", 1) for line in text.splitlines() if "|" in line)
