"""Terminal output of `g3r-infer` while it runs: a line per finished stage, a bar with the time left, the verdict.

The bar is drawn if the error stream is a terminal; otherwise only the lines are printed. The words are in
`g3r.report.stage_words`. Nothing heavy is imported here: the bar appears before torch is loaded.
"""

from __future__ import annotations

import logging
import os
import sys
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from g3r.cli.time_left import TimeLeft
from g3r.report.stage_words import COMPILING, DOING, STARTING, STOPPING, WITHOUT_FACTS, line
from g3r.report.verdict_messages import CHECK, DO_NOT_USE, USE
from g3r.run.log_file import LogFile
from g3r.run.reporter import Reporter
from g3r.run.stop_request import StopRequest

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

PROGRAM = "g3r-infer"

PLAIN, DETAIL, WARNING = "", "2", "33"
COLOURS: dict[str, str] = {USE: "1;32", CHECK: "1;33", DO_NOT_USE: "1;31"}
"""Colour codes of terminals for kinds of lines, and for the words of the verdict."""

MAX_COLUMNS = 100
"""Longer lines are hard to read."""

PER_SECOND = 4


class Terminal(Reporter):
    """Shows log lines and stages of one run, and writes all of them to the log file, as a context manager.

    Args:
        time_left: time left of the run.
        log: log file, which gets everything.
        quiet: whether only warnings and errors are shown.
        verbose: whether debug detail is shown, too.
        compiling_s: seconds to compile programs on the first run; 0 if they are compiled already.
        stop_request: stop request of the run; None if there is none.
    """

    def __init__(
        self,
        time_left: TimeLeft,
        log: LogFile,
        *,
        quiet: bool = False,
        verbose: bool = False,
        compiling_s: float = 0.0,
        stop_request: StopRequest | None = None,
    ) -> None:
        self.time_left, self.log, self.quiet = time_left, log, quiet
        self.compiling_s, self.stop_request = compiling_s, stop_request
        self.stage = STARTING
        self._level = logging.DEBUG if verbose else logging.WARNING
        self._held: list[tuple[str, str]] | None = None
        self._live: Live | None = None
        self._loggers = _Loggers([log, _Lines(self)])

    def __enter__(self) -> Terminal:
        self._loggers.install()
        if not self.quiet and is_live(sys.stderr):
            self._live = _live(self)
            self._live.start()
        self.begun(STARTING)
        if self.compiling_s:
            self.say(COMPILING.format(seconds=round(self.compiling_s)))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end_bar()
        self._loggers.remove()

    def begun(self, stage: str) -> None:
        """See `Reporter`."""
        self.stage = stage
        self.time_left.begun(stage)

    def progress(self, stage: str, done: int, total: int) -> None:
        """See `Reporter`."""
        self.time_left.progress(done, total)

    def ended(self, stage: str, found: object, *, resumed: bool = False) -> None:
        """See `Reporter`; prints lines about the result of the stage."""
        self.time_left.ended(stage)
        if stage in WITHOUT_FACTS:
            self.tell(WITHOUT_FACTS[stage], {})
        elif found is not None:
            from g3r.output.stage_facts import told_of

            for name, facts in told_of(found):
                self.tell(name, facts, resumed=resumed)

    def tell(self, name: str, facts: Mapping[str, object], *, resumed: bool = False) -> None:
        """Print a line about a stage.

        Args:
            name: key of `stage_words.LINES`.
            facts: values to fill in.
            resumed: whether the stage was taken from an earlier run.
        """
        self.say(line(name, facts, resumed=resumed))

    def say(self, text: str) -> None:
        """Print a line unless `quiet`, and log it."""
        self.log.say(text)
        if not self.quiet:
            self._show(text, PLAIN)

    def heard(self, record: logging.LogRecord) -> None:
        """Print a log record if it is a warning, or if detail is wanted."""
        if record.levelno >= logging.WARNING:
            self._show(f"{PROGRAM}: {record.getMessage()}", WARNING)
        elif record.levelno >= self._level and record.name.startswith("g3r"):
            self._show(f"  {record.getMessage()}", DETAIL)

    @contextmanager
    def held_back(self) -> Iterator[None]:
        """Hold lines back until the block succeeds, so that a refused input prints one line only."""
        self._held = []
        try:
            yield
            held, self._held = self._held, None
            for text, colour in held:
                self._show(text, colour)
        finally:
            self._held = None

    def end_bar(self) -> None:
        """Remove the bar."""
        if self._live is not None:
            live, self._live = self._live, None
            live.stop()

    def conclude(self, lines: list[str], word: str, verdict: str) -> None:
        """Print on the standard output what was written, and last the verdict.

        Args:
            lines: lines before the verdict.
            word: word of the verdict, which decides its colour.
            verdict: the line of the verdict.
        """
        self.end_bar()
        for text in lines:
            print(text if os.sep in text else _laid_out(text, PLAIN, sys.stdout))  # a path stays in one piece
        self.log.say(verdict)
        print(_laid_out(verdict, COLOURS[word], sys.stdout), flush=True)

    def _show(self, text: str, colour: str) -> None:
        if self._held is not None:
            self._held.append((text, colour))
            return
        print(_laid_out(text, colour, sys.stderr), file=sys.stderr, flush=True)

    def picture(self) -> RenderableType:
        """The bar in its present state."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        share, left_s = self.time_left.share(), round(self.time_left.left_s())
        bar = Table.grid(padding=(0, 2), expand=True)
        for width, ratio in ((max(map(len, DOING.values())), None), (None, 1), (5, None), (15, None)):
            bar.add_column(width=width, ratio=ratio, no_wrap=True)
        left = f"about {left_s // 60}:{left_s % 60:02d} left" if left_s else "nearly done"
        is_stopping = self.stop_request is not None and self.stop_request.is_requested()
        doing = STOPPING if is_stopping else DOING.get(self.stage, self.stage)
        progress = ProgressBar(1.0, share, complete_style="cyan", finished_style="cyan")
        bar.add_row(doing, progress, f"{100 * share:3.0f} %", left)
        return bar


def is_live(stream: TextIO) -> bool:
    """Whether a stream is a terminal that can redraw a line."""
    return stream.isatty() and os.environ.get("TERM", "") not in ("dumb", "unknown")


def _live(terminal: Terminal) -> Live:
    """The bar, which a thread redraws a few times a second."""
    from rich.console import Console
    from rich.live import Live

    return Live(
        get_renderable=terminal.picture,
        console=Console(file=sys.stderr, highlight=False),
        refresh_per_second=PER_SECOND,
        transient=True,
        redirect_stdout=sys.stdout.isatty(),
    )


def _laid_out(text: str, colour: str, stream: TextIO) -> str:
    """A line, wrapped and coloured if the stream is a terminal; unchanged otherwise."""
    if not stream.isatty():
        return text
    indent = text[: len(text) - len(text.lstrip())] + "  "
    columns = min(_columns(stream), MAX_COLUMNS)
    text = textwrap.fill(
        text, columns, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
    )
    if not colour or os.environ.get("NO_COLOR") or not is_live(stream):
        return text
    return "\n".join(f"\x1b[{colour}m{one}\x1b[0m" for one in text.split("\n"))


def _columns(stream: TextIO) -> int:
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


class _Lines(logging.Handler):
    """Passes log lines on to the terminal."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__(logging.DEBUG)
        self.terminal = terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record if it is to be shown."""
        try:
            self.terminal.heard(record)
        except Exception:  # as in every handler: a record that cannot be shown must not end the run
            self.handleError(record)


class _Loggers:
    """Installs handlers at the root logger for the duration of a run."""

    def __init__(self, handlers: list[logging.Handler]) -> None:
        self.handlers = handlers
        self._levels: dict[str | None, int] = {}

    def install(self) -> None:
        """Add the handlers; from now on g3r logs debug detail, and other packages only warnings."""
        for name, level in ((None, logging.WARNING), ("g3r", logging.DEBUG)):
            logger = logging.getLogger(name)
            self._levels[name] = logger.level
            logger.setLevel(level)
        for handler in self.handlers:
            logging.getLogger().addHandler(handler)

    def remove(self) -> None:
        """Remove the handlers and restore the levels."""
        for handler in self.handlers:
            logging.getLogger().removeHandler(handler)
        for name, level in self._levels.items():
            logging.getLogger(name).setLevel(level)
