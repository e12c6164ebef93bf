"""`g3r-infer` without masks, with masks for some stacks, and with the user's mask command."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from g3r.acquisition.images import load_volume
from g3r.output.files import MASK_NAMES
from tests.cli.test_infer import QUICK, files, run

LOOK_BESIDE = """
import shutil, sys
shutil.copy(sys.argv[1].replace("stack-", "mask-"), sys.argv[2])
"""


@pytest.fixture
def masker(tmp_path: Path) -> str:
    """A mask command that copies the mask beside the stack."""
    (tmp_path / "masker.py").write_text(LOOK_BESIDE)
    return f"{sys.executable} {tmp_path / 'masker.py'} {{stack}} {{mask}}"


@pytest.fixture(scope="module")
def surrounded(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The subject's stacks with surroundings added around the brain, and its masks."""
    folder = tmp_path_factory.mktemp("surrounded")
    for path in files(subject, "stack"):
        image = nib.Nifti1Image.from_filename(path)
        noise = np.random.default_rng(0).uniform(0.1, 1, image.shape)
        data = np.maximum(np.asarray(image.dataobj), noise * 0.2 * np.asarray(image.dataobj).max())
        nib.save(nib.Nifti1Image(data.astype(np.float32), image.affine), folder / path.name)
    for path in files(subject, "mask"):
        shutil.copy(path, folder)
    return folder


def test_a_masker_makes_what_is_not_given(surrounded: Path, masker: str, tmp_path: Path) -> None:
    """The volume equals that with all masks given; found masks are written, and named in record and terminal."""
    stacks, masks = files(surrounded, "stack"), files(surrounded, "mask")
    given = run("infer", "--stacks", *stacks, "--masks", *masks, *QUICK, "--output", tmp_path / "given")
    assert given.returncode == 0, given.stderr
    line = ["--stacks", *stacks, "--masks", masks[0], "auto", masks[2], "--mask-command", masker]
    found = run("infer", *line, *QUICK, "--output", tmp_path / "found")
    assert found.returncode == 0, found.stderr
    assert "masks:   command: look at" in found.stdout
    assert "masks:" not in given.stdout

    volumes = [(tmp_path / name / "volume.nii.gz").read_bytes() for name in ("given", "found")]
    assert volumes[0] == volumes[1]
    written = {path.name for path in (tmp_path / "found").iterdir()} & set(MASK_NAMES)
    assert written == {"brain-mask-1.nii.gz", "masks.png"}
    assert not {path.name for path in (tmp_path / "given").iterdir()} & set(MASK_NAMES)
    own, back = load_volume(masks[1]), load_volume(tmp_path / "found" / "brain-mask-1.nii.gz")
    np.testing.assert_array_equal(own.data > 0, back.data > 0)
    np.testing.assert_allclose(own.affine, back.affine, atol=1e-5)
    record = json.loads((tmp_path / "found" / "run.json").read_text())
    assert [stack["mask_from"] for stack in record["stacks"]] == ["file", "command", "file"]
    assert record["stacks"][1]["mask_detail"] == f"{Path(sys.executable).name} masker.py {{stack}} {{mask}}"
    texts = [path for path in (tmp_path / "found").iterdir() if path.suffix in (".json", ".txt", ".html", ".tsv")]
    assert not [path.name for path in texts if str(tmp_path) in path.read_text()]
    assert [mask["name"] for mask in record["inputs"]["masks"]] == ["mask-0.nii.gz", "command", "mask-2.nii.gz"]


def test_a_masker_that_fails_ends_the_run_in_one_line(surrounded: Path, tmp_path: Path) -> None:
    done = run("infer", "--stacks", *files(surrounded, "stack"), "--mask-command", "false {stack} {mask}",
               "--output", tmp_path / "out")  # fmt: skip
    assert done.returncode == 3
    assert done.stderr.splitlines() == [
        "g3r-infer: stack-0.nii.gz: --mask-command failed with exit code 1 and said nothing; try it alone"
    ]
    assert list(tmp_path.iterdir()) == []


def test_the_whole_image_is_brain_where_the_user_says_so(surrounded: Path, tmp_path: Path) -> None:
    done = run("infer", "--stacks", files(surrounded, "stack")[0], "--whole-image", "--dry-run", *QUICK[2:],
               "--output", tmp_path / "out")  # fmt: skip
    assert done.returncode == 0, done.stderr
    n_voxels = load_volume(files(surrounded, "stack")[0]).data.size
    assert f"{n_voxels} masked" in done.stdout


@pytest.fixture(scope="module")
def headless(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two stacks of the size of a mother, with smooth noise and no head."""
    folder, rng = tmp_path_factory.mktemp("headless"), np.random.default_rng(0)
    for n in range(2):
        data = gaussian_filter(rng.normal(size=(100, 100, 20)), (6, 6, 2))
        affine = np.diag([2.5, 2.5, 4.0, 1.0])
        nib.save(nib.Nifti1Image((data - data.min() + 0.01).astype(np.float32), affine), folder / f"{n}.nii.gz")
    return sorted(folder.iterdir())


def test_no_head_anywhere_is_refused_with_ways_on(headless: list[Path], tmp_path: Path) -> None:
    done = run("infer", "--stacks", *headless, *QUICK, "--output", tmp_path / "out")
    assert done.returncode == 3
    assert len(done.stderr.splitlines()) == 1, done.stderr
    for words in (
        "no brain was found in any stack",
        "0.nii.gz",
        "1.nii.gz",
        "--masks",
        "--mask-command",
        "--whole-image",
    ):
        assert words in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_set_of_weights_without_a_mask_network_says_so(headless: list[Path], tmp_path: Path) -> None:
    done = run("infer", "--stacks", *headless, "--ckpt", "cc0", "--output", tmp_path / "out")
    assert done.returncode == 3
    assert "--ckpt cc0: this set of weights has no mask network" in done.stderr
