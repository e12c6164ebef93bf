"""A private temporary folder for images in conversion, which is removed at the end."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from g3r.run.process_mark import is_left_over, process_mark

PREFIX = "g3r-dicom-"


@contextmanager
def private_folder() -> Iterator[Path]:
    """A new folder below the system's for temporary files (TMPDIR).

    Only this user can read it. It is removed when the block ends, also by an error or a signal. After `kill -9` the
    next run on the same machine removes it.

    Raises:
        OSError: it cannot be created.
    """
    _remove_leftovers(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=f"{PREFIX}{process_mark()}-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def _remove_leftovers(parent: Path) -> None:
    """Remove the folders left by processes that were killed.

    Folders of other users cannot be removed. Those of other machines and containers are kept, because they may be
    running.
    """
    for folder in parent.glob(f"{PREFIX}*"):
        if is_left_over(folder.name.removeprefix(PREFIX)) and not folder.is_symlink():
            shutil.rmtree(folder, ignore_errors=True)
