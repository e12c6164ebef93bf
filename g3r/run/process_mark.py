"""Tags in file names that identify the writing process, to find out whether it still runs."""

from __future__ import annotations

import os
import socket
from hashlib import sha256

import psutil

COUNT = "/proc/self/ns/pid"
"""A file whose inode number identifies the PID namespace (Linux)."""


def process_mark() -> str:
    """A tag HOST-PID for file names, unique on a shared file system."""
    return f"{_place()}-{os.getpid()}"


def is_left_over(name: str) -> bool:
    """Whether a name begins with the tag of a process that has ended.

    Processes of other machines and containers cannot be checked from here and count as running.
    """
    place, _, rest = name.partition("-")
    number = rest.partition("-")[0]
    return place == _place() and number.isdigit() and not psutil.pid_exists(int(number))


def _place() -> str:
    """Hash of the host name and the PID namespace: where a PID means the same process.

    A container may share the host's name but count its own PIDs, so the name alone does not do.
    """
    try:
        count = os.stat(COUNT).st_ino
    except OSError:  # not Linux
        count = 0
    return sha256(f"{socket.gethostname()} {count}".encode()).hexdigest()[:8]
