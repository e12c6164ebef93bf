"""Counts of cases tried, survived, refused and lost in the fault and numerics tests, printed when pytest ends.

A pytest plugin (`tests/conftest.py` loads it); use its fixture `tally` from any test:

    def test_something(tally):
        with tally.case() as case:      # one case; lost if the block raises (the error goes on)
            ...
            case.refused()              # the input was refused as it should be; else it counts as survived
        with tally.refusal():           # one case that must be refused, with an error that says why
            ...

    def test_in_a_process_of_its_own(tally):
        tally.add(tried=500, survived=120, refused=380)   # the rest, here 0, counts as lost

Rows are named after the test's file (`tests/faults/test_kills.py` gives "kills"); `tally.named("...")` gives
another name. *Survived* means: led to a right result (also when run again after a kill or a full disk).
*Refused* means: ended with the documented exit code or error and nothing written. *Lost* is everything else:
a traceback, a hang, a wrong exit code, a stray file, a wrong or incomplete result. pytest fails if
anything was lost, even if no test failed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import pytest

from g3r.errors import G3RError


@dataclass
class Counts:
    """Cases of one kind."""

    tried: int = 0
    survived: int = 0
    refused: int = 0

    @property
    def lost(self) -> int:
        """Cases that neither survived nor were refused."""
        return self.tried - self.survived - self.refused


@dataclass
class Case:
    """A case in progress."""

    was_refused: bool = False

    def refused(self) -> None:
        """Count the case as properly refused."""
        self.was_refused = True


@dataclass
class Tally:
    """Counts of one row of the table."""

    name: str
    rows: dict[str, Counts] = field(default_factory=dict)

    def named(self, name: str) -> Tally:
        """Another row of the same table."""
        return Tally(name, self.rows)

    def add(self, tried: int, survived: int = 0, refused: int = 0) -> None:
        """Count many cases at once; cases that neither survived nor were refused are lost."""
        row = self.rows.setdefault(self.name, Counts())
        row.tried += tried
        row.survived += survived
        row.refused += refused

    @contextmanager
    def case(self) -> Iterator[Case]:
        """Count one case; an error inside makes it lost and is passed on."""
        case = Case()
        try:
            yield case
        except BaseException:
            self.add(1)
            raise
        self.add(1, survived=not case.was_refused, refused=case.was_refused)

    @contextmanager
    def refusal(self) -> Iterator[None]:
        """Count one case that must raise an error of g3r, or a ValueError, with a message."""
        with self.case() as case:
            with pytest.raises((G3RError, ValueError), match=r"(?s).{10}"):
                yield
            case.refused()


def table(rows: dict[str, Counts]) -> list[str]:
    """The counts as lines of text, with a total."""
    total = Counts(*(sum(getattr(row, name) for row in rows.values()) for name in ("tried", "survived", "refused")))
    width = max(len(name) for name in [*rows, "all"])
    lines = [f"{'':<{width}} {'tried':>7} {'survived':>9} {'refused':>8} {'lost':>5}"]
    lines += [
        f"{name:<{width}} {row.tried:>7} {row.survived:>9} {row.refused:>8} {row.lost:>5}"
        for name, row in [*sorted(rows.items()), ("all", total)]
    ]
    return lines


ROWS = pytest.StashKey[dict[str, Counts]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[ROWS] = {}


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Tally:
    """The row of the test's file; see the module docstring."""
    name = request.path.stem.removeprefix("test_").replace("_", " ")
    return Tally(name, request.config.stash[ROWS])


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Add the counts of a worker of pytest-xdist."""
    for name, counts in getattr(node, "workeroutput", {}).get("tally", {}).items():
        Tally(name, node.config.stash[ROWS]).add(**counts)


def pytest_sessionfinish(session: pytest.Session) -> None:
    rows = session.config.stash[ROWS]
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["tally"] = {name: asdict(row) for name, row in rows.items()}
    if any(row.lost for row in rows.values()) and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash[ROWS]
    if not rows:
        return
    terminalreporter.section("what was tried")
    for line in table(rows):
        terminalreporter.write_line(line)
