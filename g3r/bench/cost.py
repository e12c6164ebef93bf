"""Seconds and memory of one call, with as little influence of other work on the machine as possible."""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil

MIN_REPEATS, MAX_REPEATS = 3, 30
ENOUGH_SECONDS = 0.3

PAGE_BYTES = 4096

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


def min_cpu_seconds(call: Callable[[], object]) -> float:
    """Least CPU time of several calls, after one unmeasured call."""
    call()
    best, spent, n = float("inf"), 0.0, 0
    while n < MIN_REPEATS or (spent < ENOUGH_SECONDS and n < MAX_REPEATS):
        start = time.process_time()
        call()
        seconds = time.process_time() - start
        best, spent, n = min(best, seconds), spent + seconds, n + 1
    return best


def peak_extra_bytes(call: Callable[[], object]) -> int | None:
    """Peak memory of a call beyond that of the process before it; None on systems other than Linux.

    At least one page, so that its logarithm exists.
    """
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # otherwise glibc keeps freed memory, which hides growth
    try:
        _CLEAR.write_text("5", encoding="ascii")  # resets the high-water mark to the present memory
        before = psutil.Process().memory_info().rss
        kept = call()
        peak = _high_water_bytes()
    except OSError:
        return None
    del kept
    return max(PAGE_BYTES, peak - before)


def _high_water_bytes() -> int:
    """Peak memory since the mark was reset, which psutil does not read."""
    for line in _STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise OSError(f"{_STATUS}: no VmHWM")
