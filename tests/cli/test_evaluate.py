"""`g3r-evaluate` as a process: its table, its files, its exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.images import save_volume
from g3r.cli.evaluate import main
from tests.evaluation.alexnet import save_states


@pytest.fixture
def files(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A noisy volume, its truth and mask."""
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in (24, 28, 22)), indexing="ij")
    mask = np.asarray(sum(a**2 for a in axes) < 0.7)
    truth = np.where(mask, 500 + 200 * np.sin(4 * axes[0] + 3 * axes[1] * axes[2]), 0)
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = (-24, -28, -22)
    save_volume(tmp_path / "truth.nii.gz", truth, affine)
    save_volume(tmp_path / "mask.nii.gz", mask, affine)
    save_volume(tmp_path / "volume.nii.gz", truth + rng.normal(0, 20, truth.shape) * mask, affine)
    save_volume(tmp_path / "small.nii.gz", mask[1:], affine)
    save_volume(tmp_path / "empty.nii.gz", mask & False, affine)
    save_volume(tmp_path / "nan.nii.gz", truth * np.nan, affine)
    (tmp_path / "text.nii.gz").write_text("not an image")
    return tmp_path


def options(folder: Path, **changes: str) -> list[str]:
    names = {"volume": "volume.nii.gz", "reference": "truth.nii.gz", "mask": "mask.nii.gz"} | changes
    return [part for name, file in names.items() for part in (f"--{name}", str(folder / file))]


def test_scores_as_a_process(files: Path) -> None:
    arguments = options(files, json="scores.json", sections="picture.png")
    command = [sys.executable, "-m", "g3r.cli.evaluate", *arguments]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    record = json.loads((files / "scores.json").read_text())
    assert f"{record['psnr_db']:.2f}" in run.stdout
    assert 28 < record["psnr_db"] < 33
    assert (files / "picture.png").read_bytes()[:4] == b"\x89PNG"
    assert {p.name for p in files.iterdir() if p.name.startswith(".")} == set()


@pytest.mark.parametrize(
    ("failure", "code", "says"), [(KeyboardInterrupt(), 130, "interrupted"), (MemoryError(), 4, "out of memory")]
)
def test_ctrl_c_and_little_memory_end_in_one_line(
    files: Path,
    failure: BaseException,
    code: int,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def failing(*arguments: object) -> None:
        raise failure

    monkeypatch.setattr("g3r.cli.evaluate._compare", failing)
    assert main(options(files)) == code
    said = capsys.readouterr().err
    assert said.startswith(f"g3r-evaluate: {says}")
    assert said.count("\n") == 1


def test_lpips_is_reported(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_states(files)
    assert main([*options(files, json="s.json"), "--lpips-weights", str(files)]) == 0
    found = json.loads((files / "s.json").read_text())["lpips"]
    assert f"LPIPS (AlexNet, v0.1): {found:.4f}" in capsys.readouterr().out
    assert found > 0


def test_alignment_is_reported(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*options(files), "--align"]) == 0
    assert "aligned: 0." in capsys.readouterr().out


def test_pose_error_is_reported(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "".join(f"0\t{k}\t0\t0\t0\t0\t0\t0\n" for k in range(22))
    (files / "poses.tsv").write_text("stack\tslice\trx\try\trz\ttx\tty\ttz\n" + rows)
    (files / "mask-0.nii.gz").write_bytes((files / "mask.nii.gz").read_bytes())
    assert main([*options(files, poses="poses.tsv", slices="poses.tsv", json="s.json")]) == 0
    assert "mean 0.00" in capsys.readouterr().out
    assert json.loads((files / "s.json").read_text())["poses"]["n_missing"] == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"volume": "nowhere.nii.gz"}, "no such file"),
        ({"volume": "text.nii.gz"}, "NIfTI"),
        ({"volume": "nan.nii.gz"}, "no finite value"),
        ({"mask": "small.nii.gz"}, "grid"),
        ({"mask": "empty.nii.gz"}, "empty"),
        ({"lpips-weights": "nowhere"}, "no alexnet"),
        ({"json": "no/folder/scores.json"}, "cannot be written"),
        ({"poses": "nowhere.tsv", "slices": "nowhere.tsv"}, "no such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_3(
    files: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, str], message: str
) -> None:
    assert main(options(files, **changes)) == 3
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_usage_errors(files: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--volume", "a.nii.gz"])
    assert stop.value.code == 2
    with pytest.raises(SystemExit) as stop:
        main(options(files, poses="poses.tsv"))
    assert stop.value.code == 2


# -- without a truth -------------------------------------------------------------------------------


def held_out(subject: Path, **changes: str) -> list[str]:
    names = {"volume": "truth.nii.gz", "held-out-stack": "stack-1.nii.gz", "mask": "mask-1.nii.gz"} | changes
    return [*(part for name, file in names.items() for part in (f"--{name}", str(subject / file))), "--thickness", "4"]


def test_a_stack_that_was_held_out(subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*held_out(subject), "--json", str(tmp_path / "scores.json")]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split()[0] == "PSNR"
    assert row.endswith("stack-1.nii.gz")
    (record,) = json.loads((tmp_path / "scores.json").read_text())["stacks"]
    assert f"{record['psnr_db']:.2f}" == row.split()[0]
    assert len(record["slices"]) == record["n_slices"] > 10
    assert set(record["slices"][0]) == {"slice_index", "n_pixels", "mse", "ncc", "high_pass_ncc", "ssim"}


def test_a_support_on_another_grid_is_refused(subject: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(held_out(subject, support="mask-1.nii.gz")) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "mask-1.nii.gz" in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--volume", "a", "--reference", "b"], "required: --mask"),
        (["--held-out-stack", "s", "--volume", "a"], "required: --mask"),
        (["--leave-one-out", "--stacks", "a"], "required: --masks"),
        (["--held-out-stack", "s", "--leave-one-out"], "exclude each other"),
        (["--volume", "a", "--reference", "b", "--mask", "m", "--ckpt", "c"], "--ckpt cannot go with --reference"),
        (["--held-out-stack", "s", "--volume", "a", "--mask", "m", "--align"], "--align cannot go with --held-out"),
        (["--leave-one-out", "--stacks", "a", "--masks", "b", "--volume", "v"], "--volume cannot go with --leave"),
        (["--held-out-stack", "s", "--volume", "a", "--mask", "m", "--eroded-pixels", "-1"], "expected 0 or above"),
        (["--held-out-stack", "s", "--volume", "a", "--mask", "m", "--thickness", "3", "3"], "for 1 stacks"),
        (["--leave-one-out", "--stacks", "a", "--masks", "b"], "two or more"),
        (["--leave-one-out", "--stacks", "a", "b", "--masks", "c"], "same order"),
        (["--leave-one-out", "--stacks", "a", "b", "--masks", "c", "d", "--thickness", *"123"], "for 2 stacks"),
    ],
)
def test_options_that_cannot_go_together(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_each_stack_is_predicted_by_the_others(subject: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stacks, masks = ([str(subject / f"{kind}-{n}.nii.gz") for n in range(3)] for kind in ("stack", "mask"))
    arguments = ["--stacks", *stacks, "--masks", *masks, "--thickness", "4", "--preset", "fast"]
    assert main(["--leave-one-out", *arguments]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[-1] for row in rows] == ["stack-0.nii.gz", "stack-1.nii.gz", "stack-2.nii.gz", "mean"]
    scores = [float(row[0]) for row in rows]
    assert min(scores) > 15
    assert scores[-1] == pytest.approx(np.mean(scores[:3]), abs=0.01)
