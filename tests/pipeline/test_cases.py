"""The acceptance figures on atlas cases that are not part of the repository; minutes each."""

import subprocess
import sys
from pathlib import Path

import pytest

from g3r.acquisition.images import load_mask, load_volume
from g3r.evaluation.compare import compare


@pytest.mark.slow
@pytest.mark.parametrize(("case", "psnr_db"), [("sta30-none", 29.0), ("sta30-moderate", 26.0)])
def test_quality_with_the_default_preset(shared_data: Path, tmp_path: Path, case: str, psnr_db: float) -> None:
    folder = shared_data / "cases" / case
    if not folder.is_dir():
        pytest.skip(f"{case} is not among the test data")
    command = [
        sys.executable,
        "-m",
        "g3r.cli.infer",
        "--stacks",
        *sorted(map(str, folder.glob("stack-*.nii.gz"))),
        "--masks",
        *sorted(map(str, folder.glob("mask-*.nii.gz"))),
        "--output",
        str(tmp_path / "out"),
        "--quiet",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    reference = load_volume(folder / "truth.nii.gz")
    mask = load_mask(folder / "truth-mask.nii.gz", reference)
    scores = compare(load_volume(tmp_path / "out" / "volume.nii.gz"), reference, mask, align=True).scores
    assert scores.psnr_db >= psnr_db
