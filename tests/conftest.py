"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import numba
import numpy as np
import pytest

from tests.phantoms import simulate_small_subject

# torch's threads busy-wait for each other: on two cores with any other load, small networks take
# ten times as long; commands started by tests choose their own number
os.environ.setdefault("OMP_NUM_THREADS", "1")
# with several test processes, numba's threads must not busy-wait either
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

pytest_plugins = ["tests.tally"]

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_configure() -> None:
    """Processes of pytest-xdist share the cores."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        numba.set_num_threads(max(1, numba.get_num_threads() // workers))


@pytest.fixture
def rng() -> np.random.Generator:
    """A seeded generator, fresh for each test."""
    return np.random.default_rng(20_260_101)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real and atlas-based cases that are not part of the repository; skips without it."""
    default = REPOSITORY.parent / "shared" / "data"
    folder = Path(os.environ.get("G3R_TEST_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no test data at {folder}; set G3R_TEST_DATA to the folder that holds cases/ and real/")
    return folder


@pytest.fixture(scope="session")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of three small stacks of a slightly moving phantom; tests must not write to it."""
    return simulate_small_subject(tmp_path_factory.mktemp("simulated") / "subject")
