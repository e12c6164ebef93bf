"""A finished run for the tests of this folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from g3r.cli.export_poses import main as export_poses
from g3r.reuse.finished_run import FinishedRun
from tests.cli.test_infer import files
from tests.reuse.runs import reconstruct


@pytest.fixture(scope="session")
def finished(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a quick run of the small subject, with a prior whose grid is another than the volume's."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    reconstruct(subject, folder)
    return folder


@pytest.fixture(scope="session")
def run(finished: Path) -> FinishedRun:
    """The same, read."""
    return FinishedRun.load(finished)


@pytest.fixture(scope="session")
def exported(subject: Path, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its slices with their poses, as NeSVoR has them; tests do not write to it."""
    out = tmp_path_factory.mktemp("exported") / "nesvor"
    stacks = [str(path) for path in files(subject, "stack")]
    assert export_poses([str(finished), "--format", "nesvor", "--stacks", *stacks, "--output", str(out)]) == 0
    return out
