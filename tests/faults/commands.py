"""Commands run inside the test's process, and the form that a refusal must have."""

from __future__ import annotations

import contextlib
import io
import re
import resource
import signal
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

MAX_SECONDS = 5.0
"""CPU seconds, since the machine may be busy with something else."""

MAX_WAITING_SECONDS = 60.0
"""Wall time limit for commands that wait without computing, such as on a pipe without a writer."""

MAX_BYTES = 500_000_000
"""Largest memory of a refusal, far below the sizes that the files claim."""

REMEDY = re.compile(r"(?:; |\bexpected )(?:\S+ )?\S*[A-Za-z]{2}")
"""Words that state a remedy or an expectation."""

Main = Callable[[list[str]], int]


class TooSlowError(BaseException):
    """Raised if a command takes longer than `MAX_SECONDS`; the code under test does not catch it."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command: exit code, output, seconds, peak memory, changed files."""

    code: int
    out: str
    err: str
    seconds: float
    gained_bytes: int
    changed: set[str]


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise `TooSlowError` in the block after that much CPU time, or after a minute of waiting."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooSlowError(f"longer than {seconds} s")

    clocks = ((signal.ITIMER_PROF, signal.SIGPROF, seconds), (signal.ITIMER_REAL, signal.SIGALRM, MAX_WAITING_SECONDS))
    before = [signal.signal(number, stop) for _, number, _ in clocks]
    for timer, _, limit in clocks:
        signal.setitimer(timer, limit)
    try:
        yield
    finally:
        for timer, _, _ in clocks:
            signal.setitimer(timer, 0)
        for (_, number, _), handler in zip(clocks, before, strict=True):
            signal.signal(number, handler)


def run(main: Main, arguments: Sequence[object], watched: Path) -> Outcome:
    """Run a command's `main`; exceptions other than the parser's exit are passed on."""
    out, err = io.StringIO(), io.StringIO()
    before, held, start = state(watched), _begin_peak(), time.monotonic()
    tracemalloc.start()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), within(MAX_SECONDS):
            try:
                code = main([str(one) for one in arguments])
            except SystemExit as stop:
                code = int(stop.code or 0)
        gained = max(tracemalloc.get_traced_memory()[1], _peak_bytes() - held)
    finally:
        tracemalloc.stop()
    seconds = time.monotonic() - start
    changed = {name for name, _ in before ^ state(watched)}
    return Outcome(code, out.getvalue(), err.getvalue(), seconds, gained, changed)


def assert_refused(outcome: Outcome, command: str, names: str, says: str) -> None:
    """Assert a proper refusal: exit code 3, one line with problem and remedy, nothing written, bounded memory."""
    assert outcome.code == 3, outcome
    lines = outcome.err.splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith(f"{command}: "), lines[0]
    assert names in lines[0], lines[0]
    assert re.search(says, lines[0]), lines[0]
    assert has_remedy(lines[0]), f"no remedy: {lines[0]}"
    assert outcome.out == ""
    assert outcome.changed == set()
    assert outcome.gained_bytes < MAX_BYTES, outcome


def state(folder: Path) -> set[tuple[str, object]]:
    """State of a folder: all names below it, and the bytes of ordinary files."""
    return {
        (str(path), path.read_bytes() if path.is_file() and not path.is_symlink() else path.lstat().st_mode)
        for path in folder.rglob("*")
    }


def has_remedy(line: str) -> bool:
    """Whether an error states in words what was expected or what to do; the numbers of a shape are not enough."""
    return REMEDY.search(line) is not None


def _begin_peak() -> int:
    """Reset the peak memory of the process, if the system allows it; returns the peak so far.

    The peak over the whole process would hide the memory of a command after a test that took more. Memory of Python and
    numpy is counted separately, whether touched or not; this measures the other libraries.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak_bytes()


def _peak_bytes() -> int:
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return 1024 * int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
