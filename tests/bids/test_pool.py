"""A bounded number of processes, and their end."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import psutil
import pytest

from g3r.bids import pool


def sleeper(seconds: float) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", f"import time; time.sleep({seconds})"])


@pytest.mark.parametrize("n_jobs", [1, 3])
def test_never_more_than_allowed_and_all_are_reported(n_jobs: int) -> None:
    alive: list[subprocess.Popen[bytes]] = []
    counts, codes = [], {}

    def start() -> subprocess.Popen[bytes]:
        alive.append(sleeper(0.2))
        counts.append(sum(one.poll() is None for one in alive))
        return alive[-1]

    pool.run_all([start] * 5, lambda number, code: codes.update({number: code}), n_jobs)
    assert codes == dict.fromkeys(range(5), 0)
    assert max(counts) == n_jobs


def test_an_interrupt_ends_every_process() -> None:
    alive: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        if len(alive) == 2:
            raise KeyboardInterrupt
        alive.append(sleeper(60))
        return alive[-1]

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        pool.run_all([start] * 3, lambda number, code: None, 3)
    assert all(one.returncode is not None for one in alive)
    assert time.monotonic() - began < 20


def test_a_process_that_does_not_listen_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "GRACE_S", 0.3)
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(60)"
    deaf = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert deaf.stdout
    deaf.stdout.readline()
    deaf.stdout.close()

    def start() -> subprocess.Popen[bytes]:
        if deaf.poll() is None and started:
            raise KeyboardInterrupt
        started.append(deaf)
        return deaf

    started: list[subprocess.Popen[bytes]] = []
    with pytest.raises(KeyboardInterrupt):
        pool.run_all([start, start], lambda number, code: None, 2)
    assert not psutil.pid_exists(deaf.pid) or deaf.returncode is not None


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
