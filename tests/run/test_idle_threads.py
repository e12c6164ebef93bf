"""Idle threads of a program sleep, unless the environment says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

FIND = """
import os, time
from g3r.run.idle_threads import let_threads_sleep
let_threads_sleep()
import numba, numpy
@numba.njit(parallel=True)
def add(x):
    for i in numba.prange(len(x)):
        x[i] += 1
x = numpy.zeros(1000)
add(x)
numba.threading_layer()
before = time.process_time()
for _ in range(20):
    add(x)
    time.sleep(0.01)  # less than busy threads wait
print(time.process_time() - before)
"""


def busy_s(**environment: str) -> float:
    """CPU seconds of all threads over 0.2 s in which they have nothing to do."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    run = subprocess.run(
        [sys.executable, "-c", FIND], env=kept | environment, capture_output=True, text=True, check=True
    )
    return float(run.stdout)


def test_idle_threads_take_no_core() -> None:
    assert busy_s() < 0.1


def test_the_environment_decides_where_it_says_something(monkeypatch: pytest.MonkeyPatch) -> None:
    from g3r.run.idle_threads import let_threads_sleep

    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    let_threads_sleep()
    assert os.environ["OMP_WAIT_POLICY"] == "active"
