"""Idle OpenMP threads that sleep instead of spinning.

OpenMP's threads, which run kernels and networks, wait for their next work in a busy loop by default. That takes a core
from other programs: with another process on one of two cores a reconstruction took twice as long. Sleeping threads
wake in microseconds. Only a program may decide this, since it holds for the whole process.
"""

from __future__ import annotations

import os


def let_threads_sleep() -> None:
    """Make idle threads sleep, unless OMP_WAIT_POLICY is set. For programs, before kernels are loaded.

    Processes that are started later inherit it. OpenMP reads it when it is loaded; setting it later has no effect.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
