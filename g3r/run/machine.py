"""Cores and memory that this machine offers, on Linux, macOS and Windows."""

from __future__ import annotations

import sys
from pathlib import Path

import psutil

from g3r.errors import InputError
from g3r.run.on_demand import threads_of_torch

_STATUS = Path("/proc/self/status")


def available_cores() -> int:
    """Cores that this process may use."""
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):  # macOS has none
        return len(process.cpu_affinity())
    return psutil.cpu_count() or 1


def use_threads(n_threads: int | None = None) -> int:
    """Give torch's and numba's thread pools the same number of threads; they take turns, stage by stage.

    Args:
        n_threads: number of threads; None for one per core of this process.

    Returns:
        The number in use.

    Raises:
        InputError: more than numba was started with.
    """
    import numba

    offered = _offered_threads()
    wanted = n_threads or min(available_cores(), offered)
    if wanted > offered:
        raise InputError(f"--threads {wanted}: this machine offers {offered}; choose at most that")
    numba.set_num_threads(wanted)
    threads_of_torch(wanted)
    return wanted


def use_up_to(n_threads: int) -> int:
    """Like `use_threads`, but with at most the threads that this process offers; returns their number."""
    return use_threads(min(n_threads, _offered_threads()))


def _offered_threads() -> int:
    """The number of threads that numba was started with."""
    import numba

    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def held_bytes() -> int:
    """Resident memory of this process."""
    return int(psutil.Process().memory_info().rss)


def available_bytes() -> int:
    """Memory that is still available on this machine."""
    return int(psutil.virtual_memory().available)


def peak_bytes() -> int:
    """Peak resident memory of this process so far.

    On Linux it is read from `/proc`, because `getrusage` starts with the peak of the parent process.
    """
    if _STATUS.is_file():
        for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    used = psutil.Process().memory_info()
    if hasattr(used, "peak_wset"):  # Windows
        return int(used.peak_wset)
    try:
        import resource
    except ImportError:
        return int(used.rss)
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
