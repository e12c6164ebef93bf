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

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

from tests.faults.nifti_files import write
from tests.faults.tally import Counts, Tally, table

if TYPE_CHECKING:
    from tests.faults.small_case import Killed, SmallCase


@pytest.fixture(scope="session")
def kept_networks(tmp_path_factory: pytest.TempPathFactory) -> dict[type, Callable[..., object]]:
    """Loaders that read a file once; a dry run has imported and compiled all that a command needs."""
    from g3r.cli.infer import main
    from g3r.pose_network.model import PoseModel
    from g3r.prior.model import Prior

    folder = tmp_path_factory.mktemp("warm")
    with pytest.MonkeyPatch.context() as patch:
        loaders = {}
        for kind in (Prior, PoseModel):
            loaders[kind] = functools.cache(kind.load)
            patch.setattr(kind, "load", loaders[kind])
        line = ["--stacks", str(write(folder / "a.nii")), "--output", str(folder / "out"), "--dry-run"]
        assert main(line) == 0
    return loaders


@pytest.fixture
def networks_once(kept_networks: dict[type, Callable[..., object]], monkeypatch: pytest.MonkeyPatch) -> None:
    """For commands inside this process: nothing is imported, compiled or read that is the same for all."""
    for kind, loader in kept_networks.items():
        monkeypatch.setattr(kind, "load", loader)


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
    from tests.faults.small_case import make_small_case

    return make_small_case(tmp_path_factory.mktemp("small-case"))


@pytest.fixture(scope="session")
def killed() -> Iterator[Killed]:
    """Runs of g3r-infer in processes of their own, to be killed."""
    from tests.faults.small_case import fork_server

    with fork_server() as run:
        yield run
