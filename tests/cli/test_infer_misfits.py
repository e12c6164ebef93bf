"""A misfit: left out and named, or kept at the user's request."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.images import load_volume
from g3r.evaluation.align import resample
from g3r.report.verdict_messages import DO_NOT_USE
from tests.cli.test_infer import QUICK, files, run


@pytest.fixture(scope="module")
def spoilt(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The subject's stacks; the brain pixels of the second one are permuted at random."""
    folder = tmp_path_factory.mktemp("spoilt")
    for path in [*files(subject, "stack"), *files(subject, "mask")]:
        shutil.copy(path, folder)
    image, mask = (nib.Nifti1Image.from_filename(subject / f"{kind}-1.nii.gz") for kind in ("stack", "mask"))
    data, inside = np.asarray(image.dataobj).copy(), np.asarray(mask.dataobj) > 0
    data[inside] = np.random.default_rng(0).permutation(data[inside])
    nib.save(nib.Nifti1Image(data, image.affine), folder / "stack-1.nii.gz")
    return folder


def reconstructed(folder: Path, out: Path, *options: str, without: int | None = None) -> tuple[dict[str, Any], str]:
    """The record of a run, and its terminal output."""
    stacks, masks = ([one for n, one in enumerate(files(folder, kind)) if n != without] for kind in ("stack", "mask"))
    done = run("infer", "--stacks", *stacks, "--masks", *masks, *QUICK, *options, "--output", out)
    assert done.returncode == 0, done.stderr
    return json.loads((out / "run.json").read_text()), done.stdout


def test_the_volume_is_that_of_the_others_and_the_stack_is_named(spoilt: Path, tmp_path: Path) -> None:
    record, said = reconstructed(spoilt, tmp_path / "all")
    assert [one["quality"]["left_out"] for one in record["stacks"]] == [False, True, False]
    assert record["stacks"][1]["quality"]["reliable"] is False
    assert record["stacks"][1]["n_slices"] == 0
    assert record["registration"]["reliable"]
    assert any(line.startswith("stack-1.nii.gz: left out of the volume, ") for line in record["notes"])
    assert not record["warnings"]
    (verdict,) = [line for line in said.splitlines() if line.startswith("verdict:")]
    assert DO_NOT_USE not in verdict
    page = (tmp_path / "all" / "report.html").read_text()
    assert "stack-1.nii.gz was left out" in page
    assert "<dd>2 <small>of 3</small></dd>" in page
    assert "<b>left out</b>" in page

    reconstructed(spoilt, tmp_path / "two", without=1)
    # as similar as two searches with different random numbers: 0.954 on one machine, above 0.98 on others
    ours, theirs = (load_volume(tmp_path / name / "volume.nii.gz") for name in ("all", "two"))
    moved = resample(ours, theirs.grid)
    assert np.corrcoef(moved[theirs.data > 0], theirs.data[theirs.data > 0])[0, 1] > 0.93


def test_it_stays_where_the_user_says_so(spoilt: Path, tmp_path: Path) -> None:
    record, said = reconstructed(spoilt, tmp_path / "kept", "--misfits", "keep")
    assert not any(one["quality"]["left_out"] for one in record["stacks"])
    assert record["registration"]["reliable"] is False
    (verdict,) = [line for line in said.splitlines() if line.startswith("verdict:")]
    assert DO_NOT_USE in verdict
    assert "stack-1.nii.gz does not fit the other stacks" in verdict
