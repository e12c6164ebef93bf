"""log.txt: all log lines of a run, debug detail included, with times and without folder names."""

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
"""Limit of the log, more than any run needs; later lines are dropped."""

OURS = "g3r"


class LogFile(logging.Handler):
    """Log handler that buffers all lines of g3r, and writes them to a file once that is known.

    Lines of other libraries are left out, because they might quote an image header. Folders are removed from paths. A
    file that cannot be written does not end the run.

    Args:
        paths: the user's files; their folders are hidden.
        folders: further folders to hide.
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
        """Buffer a record, and write it if there is a file."""
        try:
            text = record.getMessage()
            if record.exc_info:
                text += "\n" + logging.Formatter().formatException(record.exc_info)
        except Exception:  # a defect of the log line must not end the run
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
        """Write to the log.txt of a folder from now on, beginning with the buffered lines."""
        self.path = folder / LOG_NAME
        self._write("".join(self.lines), "w")

    def copy_to(self, folder: Path) -> None:
        """Write all lines so far to the log.txt of another folder.

        Raises:
            OSError: it cannot be written.
        """
        (folder / LOG_NAME).write_text("".join(self.lines), encoding="utf-8", errors="backslashreplace")

    def go_on_in(self, folder: Path) -> None:
        """Append further lines to the log.txt that `copy_to` wrote, in the present place of its folder."""
        self.path = folder / LOG_NAME if (folder / LOG_NAME).is_file() else None

    def _write(self, text: str, mode: str) -> None:
        if self.path is None:
            return
        with suppress(OSError), self.path.open(mode, encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
