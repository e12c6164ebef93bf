"""Names that tell which process is writing a file, and whether it still runs."""

from __future__ import annotations

import os
import socket
from hashlib import sha256

import psutil

COUNT = "/proc/self/ns/pid"
"""A file of Linux whose number says which count the numbers of processes belong to."""


def process_mark() -> str:
    """Two words for a name, `PLACE-NUMBER`: this process, among all that may share a file system."""
    return f"{_place()}-{os.getpid()}"


def is_left_over(name: str) -> bool:
    """Whether a name that begins with a mark is of a process that has ended.

    Processes of other machines and containers cannot be seen from here, so they count as running.
    """
    place, _, rest = name.partition("-")
    number = rest.partition("-")[0]
    return place == _place() and number.isdigit() and not psutil.pid_exists(int(number))


def _place() -> str:
    """Where numbers of processes mean what they mean here: one host, and one container on it.

    A container may have the host's name and a count of its own, so the name alone would not do.
    """
    try:
        count = os.stat(COUNT).st_ino
    except OSError:  # not Linux
        count = 0
    return sha256(f"{socket.gethostname()} {count}".encode()).hexdigest()[:8]
