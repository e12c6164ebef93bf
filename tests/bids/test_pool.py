"""The local pool: bounded number of processes, and how they end."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import psutil
import pytest

from g3r.bids import executor, pool
from g3r.bids.executor import Ended, Job
from g3r.bids.pool import LocalPool


def sleeper(folder: Path, seconds: float, before: str = "pass") -> Job:
    """A job that writes its process id into its log."""
    code = f"import os, signal, time; {before}; print(os.getpid(), flush=True); time.sleep({seconds})"
    return Job(words=(sys.executable, "-c", code), log=folder / f"{time.monotonic_ns()}.log")


def process_of(job: Job) -> psutil.Process | None:
    """The process of a job, once it has written its id; None if it has ended."""
    until_s = time.monotonic() + 20
    while time.monotonic() < until_s:
        lines = job.log.read_text().splitlines()
        if lines and lines[-1].isdigit():
            return psutil.Process(int(lines[-1])) if psutil.pid_exists(int(lines[-1])) else None
        time.sleep(0.02)
    raise AssertionError(f"{job.log} says nothing")


@pytest.mark.parametrize("n_jobs", [1, 3])
def test_never_more_than_allowed_and_all_are_reported(n_jobs: int, tmp_path: Path) -> None:
    jobs = [sleeper(tmp_path, 0.2) for _ in range(5)]
    running: set[int] = set()
    counts, ends = [], {}

    def begin(number: int) -> None:
        running.add(number)
        counts.append(len(running))

    def ended(number: int, how: Ended) -> None:
        running.remove(number)
        ends[number] = how

    LocalPool(n_jobs).run_all(jobs, begin, ended)
    assert [ends[number].code for number in range(5)] == [0] * 5
    assert all(0.2 <= (how.seconds or 0.0) < 20 for how in ends.values())
    assert max(counts) == n_jobs


def test_a_process_that_is_killed_has_a_reason(tmp_path: Path) -> None:
    job = sleeper(tmp_path, 0.0, "os.kill(os.getpid(), signal.SIGKILL)")
    ends: list[Ended] = []
    LocalPool(1).run_all([job], lambda number: None, lambda number, how: ends.append(how))
    assert ends[0].code is None
    assert "ended by signal 9" in ends[0].lost
    assert "fewer --jobs" in ends[0].lost


def test_an_interrupt_ends_every_process(tmp_path: Path) -> None:
    jobs = [sleeper(tmp_path, 60) for _ in range(3)]
    processes: list[psutil.Process | None] = []

    def begin(number: int) -> None:
        if number == 2:
            processes.extend(process_of(job) for job in jobs[:2])
            raise KeyboardInterrupt

    began_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        LocalPool(3).run_all(jobs, begin, lambda number, how: None)
    assert len(processes) == 2
    assert not any(process and process.is_running() for process in processes)
    assert time.monotonic() - began_s < 20


def test_a_process_that_does_not_listen_is_killed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(executor, "GRACE_S", 0.3)
    deaf = sleeper(tmp_path, 60, "signal.signal(signal.SIGTERM, signal.SIG_IGN)")
    processes: list[psutil.Process | None] = []

    def begin(number: int) -> None:
        if number == 1:
            processes.append(process_of(deaf))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        LocalPool(2).run_all([deaf, deaf], begin, lambda number, how: None)
    assert processes[0]
    assert not processes[0].is_running()


@pytest.mark.parametrize(
    ("cores", "free_gb", "jobs"), [(1, 100, 1), (2, 100, 1), (16, 100, 8), (16, 5, 3), (16, 0.5, 1)]
)
def test_jobs_by_cores_and_memory(monkeypatch: pytest.MonkeyPatch, cores: int, free_gb: float, jobs: int) -> None:
    monkeypatch.setattr(pool, "available_cores", lambda: cores)
    monkeypatch.setattr(pool, "available_bytes", lambda: int(free_gb * 1e9))
    assert pool.default_jobs() == jobs
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    assert pool.threads_each(jobs) == max(1, cores // jobs)
    monkeypatch.setitem(os.environ, "NUMBA_NUM_THREADS", "1")
    assert pool.threads_each(jobs) == 1


def test_a_process_that_cannot_start_stops_no_other(tmp_path: Path) -> None:
    jobs = [sleeper(tmp_path, 0), sleeper(tmp_path, 0)]
    jobs[0].log.mkdir()
    ends: dict[int, Ended] = {}
    LocalPool(1).run_all(jobs, lambda number: None, ends.__setitem__)
    assert ends[0].code is None
    assert "could not be started" in ends[0].lost
    assert ends[1].code == 0
