"""What the fault tests share: networks read once, a small case, runs that are killed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

from tests.faults.nifti_files import write

if TYPE_CHECKING:
    from tests.faults.small_case import Killed, SmallCase


@pytest.fixture(scope="session")
def kept_networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Callable[..., object]]:
    """Loaders that read a file once; a dry run has imported and compiled all that a command needs."""
    import g3r.reconstruct
    from g3r.cli.infer import main

    folder = tmp_path_factory.mktemp("warm")
    with pytest.MonkeyPatch.context() as patch:
        loaders = {}
        for name in ("load_prior", "load_pose_network"):
            loaders[name] = functools.cache(getattr(g3r.reconstruct, name))
            patch.setattr(g3r.reconstruct, name, loaders[name])
        line = ["--stacks", str(write(folder / "a.nii")), "--output", str(folder / "out"), "--dry-run"]
        assert main(line) == 0
    return loaders


@pytest.fixture
def networks_once(kept_networks: dict[str, Callable[..., object]], monkeypatch: pytest.MonkeyPatch) -> None:
    """For commands inside this process: nothing is imported, compiled or read that is the same for all."""
    import g3r.reconstruct

    for name, loader in kept_networks.items():
        monkeypatch.setattr(g3r.reconstruct, name, loader)


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
