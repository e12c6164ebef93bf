"""The DICOM files below a folder, recognised by their first bytes."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from g3r.run.folder_walk import walked

PREAMBLE_BYTES, MAGIC = 128, b"DICM"
"""A DICOM file has these magic bytes after a preamble of this length."""

LOOKED_AT = 1000
"""Number of files that are checked to see whether a folder holds DICOM."""


def is_dicom(path: str | os.PathLike[str]) -> bool:
    """Whether a file is DICOM, by its first bytes; False if it cannot be read."""
    try:
        return _begins_as_dicom(path)
    except (OSError, ValueError):
        return False


def _begins_as_dicom(path: str | os.PathLike[str]) -> bool:
    if not stat.S_ISREG(os.stat(path).st_mode):  # reading a pipe would block
        return False
    with open(path, "rb") as stream:
        return stream.read(PREAMBLE_BYTES + len(MAGIC))[PREAMBLE_BYTES:] == MAGIC


def dicom_files(folder: str | os.PathLike[str], unreadable: list[OSError]) -> Iterator[Path]:
    """The DICOM files below a folder, in the order of their paths.

    Args:
        folder: folder to search.
        unreadable: gets the error of each file and folder that cannot be read.
    """
    for parent, names in walked(folder, unreadable.append):
        for path in (parent / name for name in names):
            try:
                found = _begins_as_dicom(path)
            except OSError as error:
                unreadable.append(error)
                continue
            if found:
                yield path


def holds_dicom(folder: str | os.PathLike[str]) -> bool:
    """Whether there is DICOM among the first `LOOKED_AT` files below a folder, which may be a whole disk."""
    paths = (parent / name for parent, names in walked(folder) for name in names)
    return any(map(is_dicom, islice(paths, LOOKED_AT)))
