"""Sidecars and `g3r-infer`: the source of the thickness is shown, recorded in run.json, and can be repeated."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from g3r import GaussianReconstructor, load_stack
from g3r.cli.infer import main
from g3r.output.record import RunRecord
from g3r.run.machine import use_threads
from tests.cli.test_infer import files, inputs, run
from tests.faults.small_case import SmallCase, make_small_case

SIDECAR = {"SliceThickness": 3.5, "SpacingBetweenSlices": 4, "PhaseResolution": 0.5, "PhaseEncodingDirection": "i"}


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> SmallCase:
    """A case without sidecars that is reconstructed in about a second."""
    return make_small_case(tmp_path_factory.mktemp("small-case"))


def with_sidecars(subject: Path, folder: Path, content: object = SIDECAR) -> Path:
    """A copy of the subject whose stacks have sidecars."""
    copied = Path(shutil.copytree(subject, folder / "with sidecars"))
    for stack in files(copied, "stack"):
        stack.with_name(stack.name.replace(".nii.gz", ".json")).write_text(json.dumps(content))
    return copied


def test_a_dry_run_says_who_decided_and_warns_even_when_quiet(subject: Path, tmp_path: Path) -> None:
    options = ["--no-prior", "--output", tmp_path / "out", "--dry-run", "--quiet"]
    by_spacing = run("infer", *inputs(subject), *options)
    assert by_spacing.returncode == 0, by_spacing.stderr
    assert by_spacing.stdout.count("thickness 4 mm (spacing)") == 3
    assert by_spacing.stderr.count("taken as the distance of slices, 4.00 mm") == 3
    by_sidecar = run("infer", *inputs(with_sidecars(subject, tmp_path)), *options)
    assert by_sidecar.returncode == 0, by_sidecar.stderr
    assert by_sidecar.stdout.count("thickness 3.5 mm (sidecar)") == 3
    assert by_sidecar.stderr == ""
    by_option = run("infer", *inputs(subject), *options, "--thickness", "4")
    assert by_option.stdout.count("thickness 4 mm (option)") == 3
    assert by_option.stderr == ""


@pytest.mark.parametrize("content", [{"SliceThickness": "3.5"}, {"SpacingBetweenSlices": 3.5}, []])
def test_a_bad_sidecar_is_refused_in_one_line(
    subject: Path, tmp_path: Path, content: object, capsys: pytest.CaptureFixture[str]
) -> None:
    copied = with_sidecars(subject, tmp_path, content)
    options = ["--no-prior", "--thickness", "4", "--output", str(tmp_path / "out"), "--quiet"]
    assert main([*map(str, inputs(copied)), *options]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "stack-0.json" in line
    assert "expected" in line
    assert not (tmp_path / "out").exists()


def test_a_sidecar_is_never_replaced(subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stack = shutil.copy(files(subject, "stack")[0], tmp_path / "run.nii.gz")
    (tmp_path / "run.json").write_text(json.dumps(SIDECAR))
    assert main(["--stacks", str(stack), "--output", str(tmp_path), "--force", "--quiet"]) == 3
    assert "run.json: would be replaced by a result of its name" in capsys.readouterr().err
    assert json.loads((tmp_path / "run.json").read_text()) == SIDECAR


def test_a_run_is_repeated_without_its_sidecars(case: SmallCase, tmp_path: Path) -> None:
    """A run in Python with sidecars is repeated by `--config` from the images alone."""
    use_threads(1)  # the same as in the commands below
    copied = with_sidecars(case.folder, tmp_path)
    stacks = [load_stack(*pair) for pair in zip(files(copied, "stack"), files(copied, "mask"), strict=True)]
    result = GaussianReconstructor(settings=RunRecord.read(case.config).settings).reconstruct(stacks)
    result.save(tmp_path / "first")
    first = RunRecord.read(tmp_path / "first" / "run.json")
    for stack in first.stacks:
        assert (stack.thickness_mm, stack.thickness_from) == (3.5, "sidecar")
        assert stack.in_plane_fwhm_pixels == (2.4, 1.2)
        assert (stack.phase_resolution, stack.phase_axis) == (0.5, "i")
    again = replace(case, config=tmp_path / "first" / "run.json")
    assert again.run(tmp_path / "again", "--threads", "1") == 0
    assert again.run(tmp_path / "and again", "--threads", "1") == 0
    for name in ("again", "and again"):
        second = RunRecord.read(tmp_path / name / "run.json")
        assert [stack.profile() for stack in second.stacks] == [stack.profile() for stack in first.stacks]
        assert (tmp_path / name / "volume.nii.gz").read_bytes() == (tmp_path / "first" / "volume.nii.gz").read_bytes()
    assert (tmp_path / "again" / "volume.nii.gz").read_bytes() != case.volume


def test_an_option_wins_over_the_earlier_run(case: SmallCase, tmp_path: Path) -> None:
    assert case.run(tmp_path / "out", "--thickness", "3") == 0
    stacks = RunRecord.read(tmp_path / "out" / "run.json").stacks
    assert [(stack.thickness_mm, stack.thickness_from) for stack in stacks] == [(3.0, "option")] * 3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda stack: stack.update(in_plane_fwhm_pixels=[1.2]), "has 1 in-plane widths; expected 2"),
        (lambda stack: stack.update(in_plane_fwhm_pixels=[1.2, 0]), "in-plane FWHM of (1.2, 0.0) pixels; expected"),
        (lambda stack: stack.update(thickness_from="elsewhere"), "thickness_from is 'elsewhere'; expected 'option'"),
        (lambda stack: stack.update(phase_axis="x"), "phase_axis is 'x'; expected 'i' or 'j' or 'k'"),
    ],
)
def test_a_spoilt_record_is_refused(
    case: SmallCase,
    tmp_path: Path,
    change: Callable[[dict[str, Any]], None],
    says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    content = json.loads(case.config.read_text())
    change(content["stacks"][0])
    (tmp_path / "run.json").write_text(json.dumps(content))
    assert replace(case, config=tmp_path / "run.json").run(tmp_path / "out") == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
