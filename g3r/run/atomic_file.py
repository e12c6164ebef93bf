"""Files that appear whole or not at all: written under a temporary name in the same folder, then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from g3r.run.process_mark import is_left_over, process_mark


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path to write to; it becomes `path` when the block ends well, and is removed otherwise.

    Args:
        path: file to write; an earlier one is replaced.

    Raises:
        OSError: the file cannot be written or renamed.
    """
    path = Path(path)
    # Hidden, with the whole name at the end because writers choose the format by the suffix. With a random part,
    # because two containers on one file system may both be process 1. Created by the writer, so that its umask applies.
    temporary = path.with_name(f".{process_mark()}-{uuid4().hex[:8]}.{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    r"""Write a text file (UTF-8), whole or not at all.

    Bytes of file names that are no text are written as escapes, such as `\udce4`.

    Raises:
        OSError: it cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def remove_leftovers(folder: Path, suffix: str) -> None:
    """Remove temporary files of `atomic_path` whose process was killed, if it ran on this host.

    Args:
        folder: searched folder, without its subfolders.
        suffix: suffix of the files that were being written; other temporary files are left alone.
    """
    for temporary in folder.glob(f".*{suffix}"):
        if is_left_over(temporary.name.split(".")[1]):
            temporary.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until a file is on the disk.

    Raises:
        OSError: the disk is full or broken, which some systems report only now.
    """
    descriptor = os.open(path, os.O_RDWR)  # Windows cannot sync a file that is open for reading
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
