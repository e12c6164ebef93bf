"""`g3r-mask` with the user's mask command in place of the network."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from g3r.acquisition.images import load_volume
from g3r.cli.mask import main
from tests.cli.test_infer import files

LOOK_BESIDE = "import shutil, sys; shutil.copy(sys.argv[1].replace('_T2w', '_beside'), sys.argv[2])"


@pytest.fixture
def stacks(subject: Path, tmp_path: Path) -> list[Path]:
    """Three stacks with BIDS names; masks lie beside the first two."""
    (tmp_path / "in").mkdir()
    paths = [tmp_path / "in" / f"sub-01_run-{n}_T2w.nii.gz" for n in range(3)]
    for n, path in enumerate(paths):
        shutil.copy(files(subject, "stack")[n], path)
        if n < 2:
            shutil.copy(files(subject, "mask")[n], path.with_name(f"sub-01_run-{n}_beside.nii.gz"))
    return paths


@pytest.fixture
def masker(tmp_path: Path) -> str:
    (tmp_path / "masker.py").write_text(LOOK_BESIDE)
    return f"{sys.executable} {tmp_path / 'masker.py'} {{stack}} {{mask}}"


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, list[str]]:
    code = main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err.splitlines()


def test_every_stack_gets_a_mask_and_one_that_fails_stops_no_other(
    stacks: list[Path], masker: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "masks"
    code, said, failed = run(capsys, *reversed(stacks), "--output", out, "--mask-command", masker)
    assert code == 3
    assert len(failed) == 1
    assert failed[0].startswith("g3r-mask: sub-01_run-2_T2w.nii.gz: --mask-command failed")
    names = [f"sub-01_run-{n}_desc-brain_mask" for n in range(2)]
    assert {path.name for path in out.iterdir()} == {f"{n}.{kind}" for n in names for kind in ("nii.gz", "json", "png")}
    for name, stack in zip(names, stacks, strict=False):
        mask, beside = (
            load_volume(path) for path in (out / f"{name}.nii.gz", Path(str(stack).replace("T2w", "beside")))
        )
        np.testing.assert_array_equal(mask.data > 0, beside.data > 0)
        np.testing.assert_allclose(mask.affine, beside.affine, atol=1e-5)
        record = json.loads((out / f"{name}.json").read_text())
        assert record["Sources"] == [stack.name]
        assert record["MaskSource"] == "command"
        assert record["MaskDetail"] == f"{Path(sys.executable).name} masker.py {{stack}} {{mask}}"
        assert f"{name}.nii.gz: {record['VolumeMl']:.0f} ml" in said


def test_loggers_are_left_as_they_were(stacks: list[Path], masker: str, tmp_path: Path) -> None:
    logger = logging.getLogger("g3r.acquisition.slice_profile")
    level = logger.level
    assert main([str(stacks[0]), "--output", str(tmp_path / "masks"), "--mask-command", masker]) == 0
    assert logger.level == level


def test_masks_are_replaced_only_when_told(
    stacks: list[Path], masker: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [stacks[0], "--output", tmp_path, "--mask-command", masker]
    assert run(capsys, *words)[0] == 0
    code, _, failed = run(capsys, *words)
    assert code == 3
    assert "pass --force" in failed[0]
    assert run(capsys, *words, "--force")[0] == 0


def test_two_stacks_of_one_name_are_refused(
    stacks: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, failed = run(capsys, stacks[0], tmp_path / stacks[0].name, "--output", tmp_path / "out")
    assert code == 3
    assert "two stacks would have this mask" in failed[0]
    assert not (tmp_path / "out").exists()


def test_a_number_of_threads_that_cannot_be(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["a.nii", "--output", "out", "--threads", "-1"])
    assert ended.value.code == 2
    assert "--threads -1; expected at least 1" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM that can be heard")
def test_a_job_that_is_cancelled_ends_its_masker(stacks: list[Path], tmp_path: Path) -> None:
    """The mask command runs in its own process session, writes its id, cancels the job and hangs."""
    script = "import os, signal, sys, time; open(sys.argv[3], 'w').write(str(os.getpid())); "
    script += "os.kill(os.getppid(), signal.SIGTERM); time.sleep(60)"
    (tmp_path / "masker.py").write_text(script)
    masker = f"{sys.executable} {tmp_path / 'masker.py'} {{stack}} {{mask}} {tmp_path / 'process'}"
    words = [sys.executable, "-m", "g3r.cli.mask", str(stacks[0]), "--output", str(tmp_path / "out")]
    done = subprocess.run([*words, "--mask-command", masker], capture_output=True, text=True, check=False)
    assert done.returncode == 143
    assert done.stderr == "g3r-mask: interrupted; masks that were printed are whole\n"
    assert not psutil.pid_exists(int((tmp_path / "process").read_text()))


def test_a_stack_that_is_not_there(tmp_path: Path, masker: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, failed = run(capsys, "gone.nii", "--output", tmp_path, "--mask-command", masker)
    assert code == 3
    assert failed[0].startswith("g3r-mask: gone.nii")
