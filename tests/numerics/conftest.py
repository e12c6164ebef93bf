"""Counts the cases of the numerics suite: each is survived, refused with a clear error, or lost."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from g3r.errors import G3RError


class Tally:
    """Cases tried, survived and refused; a case whose block ends in any other way is lost."""

    def __init__(self) -> None:
        self.tried = self.survived = self.refused = 0

    @property
    def lost(self) -> int:
        return self.tried - self.survived - self.refused

    @contextmanager
    def case(self, may_refuse: bool = False) -> Iterator[None]:
        """One case: what is done and asserted inside."""
        self.tried += 1
        try:
            yield
        except (G3RError, ValueError) as error:
            if not may_refuse or len(str(error)) < 10:
                raise
            self.refused += 1
        else:
            self.survived += 1

    def line(self) -> str:
        return f"cases tried {self.tried}, survived {self.survived}, refused {self.refused}, lost {self.lost}"


_TALLY = Tally()


@pytest.fixture(scope="session")
def tally() -> Tally:
    return _TALLY


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if _TALLY.tried:
        terminalreporter.write_line(f"numerics: {_TALLY.line()}")
