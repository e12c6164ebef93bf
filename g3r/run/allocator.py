"""Whether the C library keeps freed memory for later or returns it to the system."""

from __future__ import annotations

import ctypes
import sys

M_MMAP_THRESHOLD = -3
"""Name of the parameter in glibc's malloc.h (man 3 mallopt)."""

LARGE_BLOCK_BYTES = 1_000_000


def release_memory() -> None:
    """Return freed memory to the system, if the C library is glibc; takes about 0.05 s."""
    trim = _libc_function("malloc_trim")
    if trim is not None:
        trim(ctypes.c_size_t(0))


def release_memory_eagerly() -> bool:
    """Return large blocks to the system as soon as they are freed, from now on; True if this system can.

    By default glibc raises its threshold and keeps freed blocks of up to 32 MB, and small blocks between them prevent
    their return. Setting the threshold here stops it from growing. The system then clears each block when it is
    allocated: about a seventh more CPU time (docs/tradeoff.md).
    """
    set_option = _libc_function("mallopt")
    return set_option is not None and bool(set_option(M_MMAP_THRESHOLD, LARGE_BLOCK_BYTES))


def can_release_memory_eagerly() -> bool:
    """Whether `release_memory_eagerly` would have an effect."""
    return _libc_function("mallopt") is not None


def _libc_function(name: str) -> ctypes._NamedFuncPointer | None:
    """A function of glibc; None with another library, whose functions may differ."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return getattr(library, name, None) if hasattr(library, "gnu_get_libc_version") else None
