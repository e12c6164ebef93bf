"""log.txt: everything that a run says, the developers' detail included, with times and without folders."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from g3r.run.hidden_folders import HiddenFolders

LOG_NAME = "log.txt"

MAX_CHARACTERS = 20_000_000
"""More than any run says; what comes after it is dropped."""

OURS = "g3r"


class LogFile(logging.Handler):
    """Keeps all lines of g3r, and writes them to a file as soon as it is told where.

    Lines of other libraries are left out: nobody knows what they may quote of a header. Folders are left out of
    paths. A file that cannot be written does not end the run.

    Args:
        paths: of the user's files; the folders that they are in are not to be named.
        folders: of the user, not to be named either.
    """

    def __init__(self, paths: Iterable[str] = (), folders: Iterable[str] = ()) -> None:
        super().__init__(logging.DEBUG)
        self.begun_s = time.monotonic()
        self.lines: list[str] = []
        self.n_characters = 0
        self.path: Path | None = None
        self.addFilter(logging.Filter(OURS))
        self.hidden = HiddenFolders([*(os.path.dirname(path) for path in paths), *folders])

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record, and write it where there is a file."""
        try:
            text = record.getMessage()
            if record.exc_info:
                text += "\n" + logging.Formatter().formatException(record.exc_info)
        except Exception:  # a line that cannot be formatted is a defect, and none of the run's
            return
        level = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
        self.say(f"{record.name}: {level}{text}")

    def say(self, text: str) -> None:
        """Add a line with its time."""
        passed = time.monotonic() - self.begun_s
        line = f"{time.strftime('%H:%M:%S')} {passed:8.2f} s  {self.hidden.left_out_of(text)}\n"
        if self.n_characters > MAX_CHARACTERS:
            return
        self.n_characters += len(line)
        self.lines.append(line)
        self._write(line, "a")

    def keep_in(self, folder: Path) -> None:
        """Write to the log.txt of a folder from now on, beginning with all that was said."""
        self.path = folder / LOG_NAME
        self._write("".join(self.lines), "w")

    def copy_to(self, folder: Path) -> None:
        """Write all that was said until now to the log.txt of another folder.

        Raises:
            OSError: it cannot be written.
        """
        (folder / LOG_NAME).write_text("".join(self.lines), encoding="utf-8", errors="backslashreplace")

    def go_on_in(self, folder: Path) -> None:
        """Write further lines to the log.txt that `copy_to` wrote, wherever its folder has been moved."""
        self.path = folder / LOG_NAME if (folder / LOG_NAME).is_file() else None

    def _write(self, text: str, mode: str) -> None:
        if self.path is None:
            return
        with suppress(OSError), self.path.open(mode, encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
