"""What this machine can do at best, for comparison: copying memory, and fused multiply-adds."""

from __future__ import annotations

import time
from collections.abc import Callable

import numba
import numpy as np

f32 = np.float32

COPY_BYTES = 2**27
"""Beyond any cache."""

N_IN_CACHE, N_TURNS, N_FUSED = 2048, 2000, 64
"""Numbers that stay in the innermost cache, how often they are taken, and operations on each."""


def best_seconds(call: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    """Least time of several calls, after one that is not counted."""
    call()
    seconds = []
    for _ in range(repeats):
        start = clock()
        call()
        seconds.append(clock() - start)
    return min(seconds)


@numba.njit(cache=True)
def _copy(source, target):
    for i in range(len(source)):
        target[i] = source[i]


@numba.njit(cache=True, fastmath={"contract"})
def _fused(values, turns, a, b, c, d):
    """Four chains of sixteen fused multiply-adds on each value, independent of each other."""
    total = f32(0.0)
    for _ in range(turns):
        for i in range(len(values)):
            x = values[i]
            p, q, r, s = x, x, x, x
            for _ in range(16):
                p = p * x + a
                q = q * x + b
                r = r * x + c
                s = s * x + d
            values[i] = (p + q) + (r + s)
        total += values[0]
        values[:] = f32(0.5)
    return total


def copy_bytes_per_second(repeats: int = 5) -> float:
    """Bytes read and written per second by one core."""
    source, target = np.ones(COPY_BYTES // 4, np.float32), np.zeros(COPY_BYTES // 4, np.float32)
    return 2 * COPY_BYTES / best_seconds(lambda: _copy(source, target), repeats, time.thread_time)


def fused_per_second(repeats: int = 5) -> float:
    """Fused multiply-adds (of one number each) per second by one core."""
    values = np.full(N_IN_CACHE, 0.5, np.float32)
    small = [f32(x) for x in (0.1, 0.2, 0.3, 0.4)]
    seconds = best_seconds(lambda: _fused(values, N_TURNS, *small), repeats, time.thread_time)
    return N_IN_CACHE * N_TURNS * N_FUSED / seconds
