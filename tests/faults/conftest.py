"""Fixtures of the fault tests: networks read once, a small case, runs that are killed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

from tests.faults.nifti_files import write

if TYPE_CHECKING:
    from tests.faults.small_case import Killed, SmallCase


@pytest.fixture(scope="session")
def kept_networks(tmp_path_factory: pytest.TempPathFactory) -> dict[type, Callable[..., object]]:
    """Loaders that read each file once; a dry run has imported and compiled everything that a command needs."""
    from g3r.cli.infer import main
    from g3r.pose_network.model import PoseModel
    from g3r.prior.model import Prior

    folder = tmp_path_factory.mktemp("warm")
    with pytest.MonkeyPatch.context() as patch:
        loaders: dict[type, Callable[..., object]] = {}
        for kind in (Prior, PoseModel):
            loaders[kind] = functools.cache(kind.load)
            patch.setattr(kind, "load", loaders[kind])
        line = ["--stacks", str(write(folder / "a.nii")), "--whole-image", "--output", str(folder / "out"), "--dry-run"]
        assert main(line) == 0
    return loaders


@pytest.fixture
def networks_once(kept_networks: dict[type, Callable[..., object]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands inside this process reuse what is imported, compiled and read once for all."""
    for kind, loader in kept_networks.items():
        monkeypatch.setattr(kind, "load", loader)


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> SmallCase:
    """A case that is reconstructed in about a second."""
    from tests.faults.small_case import make_small_case

    return make_small_case(tmp_path_factory.mktemp("small-case"))


@pytest.fixture(scope="session")
def killed() -> Iterator[Killed]:
    """Runs of g3r-infer in separate processes, to be killed."""
    from tests.faults.small_case import fork_server

    with fork_server() as run:
        yield run
