"""A finished run, shared by the tests of this folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from g3r.cli.export_poses import main as export_poses
from g3r.reuse.finished_run import FinishedRun
from tests.cli.test_infer import files
from tests.reuse.runs import reconstruct


@pytest.fixture(scope="session")
def finished(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a quick run of the small subject, with a prior on a grid that differs from the volume's."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    reconstruct(subject, folder)
    return folder


@pytest.fixture(scope="session")
def run(finished: Path) -> FinishedRun:
    """The finished run, read from its folder."""
    return FinishedRun.load(finished)


@pytest.fixture(scope="session")
def exported(subject: Path, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its slices with their poses in the format of NeSVoR; tests must not write to it."""
    out = tmp_path_factory.mktemp("exported") / "nesvor"
    stacks = [str(path) for path in files(subject, "stack")]
    assert export_poses([str(finished), "--format", "nesvor", "--stacks", *stacks, "--output", str(out)]) == 0
    return out
