"""Progress bars, and log lines that are held back until the input has been checked."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import MemoryHandler
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from g3r.run.context import Progress


@contextmanager
def progress_bars(*, quiet: bool) -> Iterator[Progress]:
    """A progress function that draws a bar per stage, or nothing."""
    if quiet:
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<14}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(str(stage), total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report


@contextmanager
def log_held_back() -> Iterator[None]:
    """Hold log lines back until the block ends well, so that a refusal is one line."""
    root = logging.getLogger()
    streams = root.handlers
    held = [MemoryHandler(1000, logging.CRITICAL + 1, stream, flushOnClose=False) for stream in streams]
    root.handlers = list(held)
    try:
        yield
        for handler in held:
            handler.flush()
    finally:
        root.handlers = streams
