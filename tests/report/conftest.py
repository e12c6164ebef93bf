"""One output folder for all tests of the report: a small result whose headers name a patient."""

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
    """Two stacks, their masks beside them, with a name in every field of the headers and of the folder."""
    folder = tmp_path_factory.mktemp("data") / CANARY
    folder.mkdir()
    for n in range(2):
        planted(folder / f"mask-{n}.nii.gz", ball())
    head = 200 * gaussian_filter(ball().astype(np.float32), 1)
    return [planted(folder / f"stack-{n}.nii.gz", gaussian_filter(image(n), (2, 2, 1)) + head) for n in range(2)]


@pytest.fixture(scope="session")
def finished(planted_stacks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What g3r-infer wrote of them, in a folder with a space in its name."""
    folder = tmp_path_factory.mktemp("results") / "one run"
    masks = [path.with_name(path.name.replace("stack", "mask")) for path in planted_stacks]
    line = ["--stacks", *planted_stacks, "--masks", *masks, "--preset", "fast", "--no-prior", "--resolution", "3"]
    assert main([*map(str, line), "--threads", "1", "--quiet", "--output", str(folder)]) == 0
    return folder
