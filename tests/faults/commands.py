"""Commands run inside the test's process, and what a refusal must look like."""

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
"""Of a processor: the machine may be busy with something else."""

MAX_WAITING_SECONDS = 60.0
"""For what waits without computing, such as a pipe that nobody writes to."""

MAX_BYTES = 500_000_000
"""That a refusal may take at most: far under what the files claim."""

REMEDY = re.compile(r"(?:; |\bexpected )(?:\S+ )?\S*[A-Za-z]{2}")
"""What to do, or what was expected, in words."""

Main = Callable[[list[str]], int]


class TooSlowError(BaseException):
    """A command took longer than `MAX_SECONDS`; no handler of the code under test catches it."""


@dataclass(frozen=True)
class Outcome:
    """What a command did: its exit code, what it printed, seconds, memory it took at most, files that changed."""

    code: int
    out: str
    err: str
    seconds: float
    gained_bytes: int
    changed: set[str]


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise `TooSlowError` in the block once it has computed that long, or waited for a minute."""

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
    """Run a command's `main`; an exception other than the parser's exit goes on."""
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
    """Exit code 3, one line that names what is wrong and says what to do, nothing written, memory bounded."""
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
    """Everything below a folder: names, and the bytes of ordinary files."""
    return {
        (str(path), path.read_bytes() if path.is_file() and not path.is_symlink() else path.lstat().st_mode)
        for path in folder.rglob("*")
    }


def has_remedy(line: str) -> bool:
    """Whether an error says what was expected or what to do, in words: numbers of a shape are no remedy."""
    return REMEDY.search(line) is not None


def _begin_peak() -> int:
    """Make the peak of the process's memory begin anew, where the system lets it; returns the peak so far.

    The peak of a whole life would hide what a command takes after a test that took more. What Python and numpy take
    is counted by itself, whether they touch it or not: this is for the other libraries.
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
