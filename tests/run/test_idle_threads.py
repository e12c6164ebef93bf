"""Idle threads of a program sleep, unless the environment sets another policy."""

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
assert numba.get_num_threads() == 2
idle_s = busy_s = 0.0
for _ in range(20):
    add(x)
    begun, computed = time.perf_counter(), time.process_time()
    time.sleep(0.01)  # less than busy threads wait
    busy_s += time.process_time() - computed
    idle_s += time.perf_counter() - begun
print(busy_s / idle_s)
"""


def busy_share(**environment: str) -> float:
    """Share of a core that two idle threads use, independent of the machine's speed and number of cores.

    Other load on the machine can only lower it.
    """
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    run = subprocess.run(
        [sys.executable, "-c", FIND],
        env=kept | {"NUMBA_NUM_THREADS": "2"} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(run.stdout)


def test_idle_threads_take_no_core() -> None:
    assert busy_share() < 0.4


def test_the_environment_decides_where_it_says_something(monkeypatch: pytest.MonkeyPatch) -> None:
    from g3r.run.idle_threads import let_threads_sleep

    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    let_threads_sleep()
    assert os.environ["OMP_WAIT_POLICY"] == "active"
