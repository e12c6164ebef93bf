"""What threads do while they have nothing to do.

OpenMP's threads, on which kernels and networks run, wait for their next work in a busy loop by default. That takes a
core from whatever else runs: with another process on one of two cores a reconstruction took twice as long. Sleeping
threads wake in microseconds. Only a program may decide this, since it holds for all of the process.
"""

from __future__ import annotations

import os


def let_threads_sleep() -> None:
    """From now on idle threads sleep, unless the environment says otherwise. For programs, before kernels are loaded.

    Processes that are started later inherit it. OpenMP reads it when it is loaded: later than that it does nothing.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
