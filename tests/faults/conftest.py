"""Counts of the fault tests: cases tried, survived, refused and lost, printed when pytest ends.

Use the fixture `tally` from any test of this folder:

    def test_something(tally):
        with tally.case() as case:      # one case; lost if the block raises (the error goes on)
            ...
            case.refused()              # the input was refused as it should be; else it counts as survived

    def test_in_a_process_of_its_own(tally):
        tally.add(tried=500, survived=120, refused=380)   # the rest, here 0, counts as lost

Rows are named after the test's file (`tests/faults/test_kills.py` gives "kills"); `tally.named("...")` gives
another name. *Survived* means: went on to a right result (also after a kill or a full disk, once run again).
*Refused* means: ended with the documented exit code or error and nothing written. *Lost* is everything else:
a traceback, a hang, a wrong exit code, a stray file, a result that is wrong or half there. pytest fails where
anything was lost, even if a test forgot to.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from tally import Counts, Tally, table

if TYPE_CHECKING:
    from small_case import Killed, SmallCase

ROWS = pytest.StashKey[dict[str, Counts]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[ROWS] = {}


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Tally:
    """Counts cases in the row of the test's file; see the top of this file."""
    name = request.path.stem.removeprefix("test_").replace("_", " ")
    return Tally(name, request.config.stash[ROWS])


def pytest_sessionfinish(session: pytest.Session) -> None:
    if any(row.lost for row in session.config.stash[ROWS].values()) and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash[ROWS]
    if not rows:
        return
    terminalreporter.section("faults: what was tried")
    for line in table(rows):
        terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> SmallCase:
    """A case that is reconstructed in about a second."""
    from small_case import make_small_case

    return make_small_case(tmp_path_factory.mktemp("small-case"))


@pytest.fixture(scope="session")
def killed() -> Iterator[Killed]:
    """Runs of g3r-infer in processes of their own, to be killed."""
    from small_case import fork_server

    with fork_server() as run:
        yield run
