"""`g3r-infer --anatomy generic`: stacks of an object that is not a brain."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_synth import cli as simulate
from data_synth.objects import textured_ellipsoids
from g3r.cli import evaluate, infer
from g3r.cli.infer_options import parsed_options
from g3r.cli.infer_task import earlier_run
from g3r.cli.mask_options import needs_network
from g3r.output.record import RunRecord
from g3r.output.stack_record import StackRecord
from g3r.planning.anatomy import GENERIC
from g3r.planning.presets import for_anatomy
from g3r.report.verdict import verdict_of
from g3r.report.verdict_messages import USE
from tests.faults.small_case import quick_settings


def simulated(folder: Path, seed: int, *options: str) -> Path:
    assert simulate.main(["--object", "--seed", str(seed), *options, "--output", str(folder)]) == 0
    return folder


def run(case: Path, output: Path, *options: str) -> int:
    files = [str(case / f"{kind}-{n}.nii.gz") for kind in ("stack", "mask") for n in range(3)]
    line = ["--anatomy", "generic", "--stacks", *files[:3], "--masks", *files[3:], "--output", str(output), "--quiet"]
    return infer.main([*line, *options])


def pose_error_mm(case: Path, output: Path) -> float:
    """Median pose error over points of the slices, as written by g3r-evaluate."""
    line = ["--poses", case / "poses.tsv", "--slices", output / "slices.tsv", "--json", output / "scores.json"]
    truth = ["--volume", output / "volume.nii.gz", "--reference", case / "truth.nii.gz", "--align"]
    assert evaluate.main([*map(str, [*line, *truth, "--mask", case / "truth-mask.nii.gz"])]) == 0
    return json.loads((output / "scores.json").read_text())["poses"]["median_mm"]


def test_an_object_is_reconstructed_without_networks(tmp_path: Path) -> None:
    case = simulated(tmp_path / "case", 3, "--resolution", "1.6", "--thickness", "4", "--motion", "mild")
    output = tmp_path / "out"
    assert run(case, output, "--thickness", "4", "--preset", "fast", "--resolution", "2", "--threads", "1") == 0
    record = RunRecord.read(output / "run.json")
    assert record.settings.anatomy == "generic"
    assert record.inputs is not None
    assert record.inputs.prior is record.inputs.pose_network is record.inputs.mask_network is None
    assert record.registration is not None
    assert record.registration.space == "scanner"
    assert any("generic" in note for note in record.notes)
    verdict = verdict_of(record)
    assert verdict.word == USE
    assert "slices saw the whole object" in verdict.line()
    assert pose_error_mm(case, output) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_poses_of_an_object_that_moves_moderately(seed: int, tmp_path: Path) -> None:
    case = simulated(tmp_path / "case", seed, "--motion", "moderate")
    assert run(case, tmp_path / "out", "--thickness", "2.2") == 0
    assert pose_error_mm(case, tmp_path / "out") < 0.5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--space", "standard"], "--space standard"),
        (["--ckpt", "cc0"], "--ckpt"),
        (["--pose-ckpt", "a.safetensors", "--mask-ckpt", "b.safetensors"], "--pose-ckpt, --mask-ckpt"),
    ],
)
def test_what_needs_a_brain_is_refused(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(tmp_path, tmp_path / "out", *options)
    assert ended.value.code == 2
    assert f"--anatomy generic and {words} exclude each other" in capsys.readouterr().err


def test_nobody_looks_for_a_brain(subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stacks = [str(subject / f"stack-{n}.nii.gz") for n in range(3)]
    assert infer.main(["--anatomy", "generic", "--stacks", *stacks, "--output", str(tmp_path / "out")]) == 3
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line]
    assert "no mask says what is to be reconstructed" in line
    assert not (tmp_path / "out").exists()


def test_nobody_looks_for_a_brain_in_a_repetition(
    subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stacks = [str(subject / f"stack-{n}.nii.gz") for n in range(3)]
    record = RunRecord(
        settings=for_anatomy(quick_settings(), GENERIC),
        stacks=[StackRecord(name=Path(stack).name, thickness_mm=4.0) for stack in stacks],
    )
    (tmp_path / "run.json").write_text(record.to_json())
    words = ["--config", str(tmp_path / "run.json"), "--stacks", *stacks, "--output", str(tmp_path / "out")]
    options = parsed_options(words)
    earlier_run(options)
    assert not needs_network(options)
    assert infer.main(words) == 3
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line]
    assert "no mask says what is to be reconstructed" in line


def test_the_object_is_the_same_each_time_and_no_mirror_image_of_itself() -> None:
    one, again, other = (textured_ellipsoids(2.0, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.data, again.data)
    assert one.mask.shape == other.mask.shape
    assert np.abs(one.data - other.data)[one.mask].mean() > 0.05
    assert one.data[~one.mask].max() == 0
    assert np.percentile(one.data[one.mask], 99.5) == pytest.approx(1)
    for axis in range(3):
        assert np.corrcoef(one.data.ravel(), np.flip(one.data, axis).ravel())[0, 1] < 0.9
