"""Output folder shared by the report tests: a small result of stacks whose headers name a patient."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from g3r.cli.infer import main
from tests.faults.nifti_files import ball, image
from tests.faults.test_no_leaks import CANARY, planted


@pytest.fixture(scope="session")
def planted_stacks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two stacks and their masks, with a name in every header field and in the folder's name."""
    folder = tmp_path_factory.mktemp("data") / CANARY
    folder.mkdir()
    for n in range(2):
        planted(folder / f"mask-{n}.nii.gz", ball())
    head = 200 * gaussian_filter(ball().astype(np.float32), 1)
    return [planted(folder / f"stack-{n}.nii.gz", gaussian_filter(image(n), (2, 2, 1)) + head) for n in range(2)]


@pytest.fixture(scope="session")
def finished(planted_stacks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Their output folder of g3r-infer, with a space in its name."""
    folder = tmp_path_factory.mktemp("results") / "one run"
    masks = [path.with_name(path.name.replace("stack", "mask")) for path in planted_stacks]
    line = ["--stacks", *planted_stacks, "--masks", *masks, "--preset", "fast", "--no-prior", "--resolution", "3"]
    assert main([*map(str, line), "--threads", "1", "--quiet", "--output", str(folder)]) == 0
    return folder
