"""Errors that a user can act on, with the exit code of the command line for each."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

MEGABYTE = 1e6

OUT_OF_MEMORY_WORDS = ("allocate memory", "failed to map segment", "can't start new thread", "out of memory")
"""Phrases for lack of memory in messages of numpy, torch, the library loader and the system."""


class G3RError(Exception):
    """Base of every error that g3r raises on purpose; the message is one actionable line."""

    exit_code = 1

    def __str__(self) -> str:
        """The message on one line, whatever file names and headers contain."""
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in super().__str__())


class InputError(G3RError):
    """The input cannot be used: names the file, what was found, what was expected, what to do."""

    exit_code = 3


class NumericalError(G3RError):
    """The computation broke down; results so far are kept and marked."""

    exit_code = 4


def one_line(error: BaseException) -> str:
    """The first 120 characters of an error's text, without line breaks; the name of its type if it has no text."""
    text = " ".join(str(error).split())
    return text[:120] if text else type(error).__name__


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or one of its causes, means lack of memory."""
    while error is not None:
        message = str(error).lower()
        if isinstance(error, MemoryError) or any(words in message for words in OUT_OF_MEMORY_WORDS):
            return True
        error = error.__cause__ or error.__context__
    return False


def cannot_be_written(path: str | os.PathLike[str], error: OSError, needed_bytes: int | None = None) -> InputError:
    """The error to raise where a file or folder could not be written.

    Args:
        path: of the file or folder.
        error: of the system.
        needed_bytes: size of the file at most, if known.
    """
    reason = error.strerror or type(error).__name__
    if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return InputError(f"{path}: cannot be written ({reason}); choose another --output")
    needed = "" if needed_bytes is None else f", at most {needed_bytes / MEGABYTE:.1f} MB are needed"
    free = _free_bytes(Path(path))
    # a quota or a limit on the size of files leaves the disk itself with space
    left = "" if free is None else f", {free / MEGABYTE:.1f} MB are free"
    return InputError(f"{path}: cannot be written ({reason}{needed}{left}); free some space or choose another --output")


def _free_bytes(path: Path) -> int | None:
    """Space on the disk of a path that need not exist."""
    for folder in (path, *path.absolute().parents):
        try:
            return shutil.disk_usage(folder).free
        except OSError:
            continue
    return None
