"""A walk through a folder that follows links, as data sets that are put together by links need."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path


def walked(
    folder: str | os.PathLike[str], unreadable: Callable[[OSError], None] | None = None
) -> Iterator[tuple[Path, list[str]]]:
    """Each folder from `folder` on with the sorted names of its files, in the order of their paths.

    Links to folders are followed. A folder that has several names is visited once, so that no circle is endless.

    Args:
        folder: where to begin.
        unreadable: called with the error of each folder that cannot be listed.
    """
    visited: set[tuple[int, int]] = set()
    for parent, folders, names in os.walk(folder, onerror=unreadable, followlinks=True):
        found = os.stat(parent)
        if (found.st_dev, found.st_ino) in visited:
            folders.clear()
            continue
        visited.add((found.st_dev, found.st_ino))
        folders.sort()
        yield Path(parent), sorted(names)
