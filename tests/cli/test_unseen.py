"""The unseen part of the brain: filled or left blank, and always reported and recorded."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r import GaussianReconstructor, load_stack
from g3r.acquisition.images import load_volume, save_volume
from g3r.uncertainty.unseen import MENTIONED_ABOVE
from tests.quick import QUICK_FIT

N_MISSING = 4


@pytest.fixture(scope="module")
def stack(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A stack with blanked slices in the middle, and its mask."""
    folder = tmp_path_factory.mktemp("missing")
    paths = []
    masked = np.asarray(nib.Nifti1Image.from_filename(subject / "mask-0.nii.gz").dataobj).any((0, 1))
    first = int(np.flatnonzero(masked).mean()) - N_MISSING // 2
    for kind in ("stack", "mask"):
        image = nib.Nifti1Image.from_filename(subject / f"{kind}-0.nii.gz")
        data = np.asarray(image.dataobj).astype(np.float32)
        data[:, :, first : first + N_MISSING] = 0
        paths.append(folder / f"{kind}.nii.gz")
        save_volume(paths[-1], data, image.affine)
    return paths[0], paths[1]


def test_blank_leaves_zeros_and_says_so(stack: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "g3r.cli.infer", "--stacks", stack[0], "--masks", stack[1], "--output", out]
    command += ["--preset", "fast", "--resolution", "2", "--no-prior", "--thickness", "4", "--threads", "1"]
    done = subprocess.run([*map(str, command), "--unseen", "blank"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    volume, mask, unseen, error = (
        load_volume(out / f"{name}.nii.gz").data for name in ("volume", "mask", "unseen", "uncertainty")
    )
    missing = unseen > 0
    assert missing.sum() > 100
    for one in (volume, mask, error):
        assert (one[missing] == 0).all()
    assert (volume[mask > 0] != 0).mean() > 0.99
    record = json.loads((out / "run.json").read_text())
    said = record["unseen"]
    share = missing.sum() / (missing.sum() + (mask > 0).sum())
    assert said["share"] == pytest.approx(share, abs=1e-6)
    assert said["volume_ml"] == pytest.approx(missing.sum() * 8 / 1000, rel=1e-4)
    assert said["shown"] == "blank"
    (line,) = [one for one in done.stdout.splitlines() if one.startswith("verdict:")]
    assert "was left blank" in line
    assert any("was left blank" in one for one in record["warnings"])


def test_filled_the_unseen_part_is_brain_and_not_blank(stack: tuple[Path, Path], subject: Path) -> None:
    settings = replace(
        QUICK_FIT,
        resolution_mm=2.0,
        use_prior=False,
        registration=replace(QUICK_FIT.registration, n_rounds=0, template=False, network=False),
        slice_stage=replace(QUICK_FIT.slice_stage, n_steps=3),
    )
    reconstructor = GaussianReconstructor(settings=settings)
    result = reconstructor.reconstruct([load_stack(*stack, 4.0)])
    assert result.record.unseen is not None
    assert result.record.unseen.shown == "smooth continuation"
    assert 0.05 < result.record.unseen.share < 0.4
    assert result.unseen.any()
    assert result.mask[result.unseen].all()
    seen = result.mask & ~result.unseen
    assert (result.volume[result.unseen] > 0).mean() > 0.9
    assert result.volume[result.unseen].mean() == pytest.approx(result.volume[seen].mean(), rel=0.3)
    # the complete stack has no unseen part worth reporting
    whole = reconstructor.reconstruct([load_stack(subject / "stack-0.nii.gz", subject / "mask-0.nii.gz", 4.0)])
    assert whole.record.unseen is not None
    assert whole.record.unseen.share < MENTIONED_ABOVE
    assert whole.record.unseen.line() is None
    # and the mask with the filled part is about as large as that of the complete stack
    assert result.mask.sum() == pytest.approx(whole.mask.sum(), rel=0.08)
