"""Refusals of the commands on a finished run: one line, exit code 3, and nothing written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.images import save_volume
from g3r.cli import apply, export_poses, render
from tests.cli.test_infer import files

Damage = Callable[[Path], object]


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def refused(capsys: pytest.CaptureFixture[str], command: Callable[[list[str]], int], *words: object) -> str:
    """The one line that a command ends with."""
    capsys.readouterr()
    assert command([str(word) for word in words]) == 3
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    return line


DAMAGES: dict[str, tuple[Damage, str]] = {
    "no record": (lambda run: (run / "run.json").unlink(), "run.json: cannot be read"),
    "another JSON": (lambda run: write(run / "run.json", "{}"), "is not a run.json of this version"),
    "a configuration": (lambda run: unregister(run / "run.json"), "is a configuration, of no run"),
    "no geometry": (lambda run: (run / "reuse.npz").unlink(), "reuse.npz: no such file"),
    "cut geometry": (lambda run: cut(run / "reuse.npz"), "reuse.npz: was not written by g3r"),
    "text for geometry": (lambda run: write(run / "reuse.npz", "x"), "reuse.npz: was not written by g3r"),
    "no Gaussians": (lambda run: (run / "gaussians.npz").unlink(), "not a cloud written by g3r"),
    "cut Gaussians": (lambda run: cut(run / "gaussians.npz"), "not a cloud written by g3r"),
    "no prior": (lambda run: (run / "prior.nii.gz").unlink(), "prior.nii.gz: no such file"),
    "cut density": (lambda run: cut(run / "density.nii.gz"), "density.nii.gz"),
    "another prior": (lambda run: shutil.copy(run / "mask.nii.gz", run / "prior.nii.gz"), "reuse.npz expects"),
}


def write(path: Path, text: str) -> None:
    path.write_text(text)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def unregister(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"registration": None}))


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_run(copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    damage, expected = DAMAGES[name]
    damage(copy)
    out = tmp_path / "out.nii.gz"
    line = refused(capsys, render.main, copy, "--output", out)
    assert line.startswith("g3r-render: ")
    assert expected in line
    assert {path.name for path in tmp_path.iterdir()} == {"run"}


def test_no_run_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = (tmp_path / "none", "--output", tmp_path / "out.nii.gz")
    assert "is no folder; pass the output folder" in refused(capsys, render.main, *words)
    assert "is no folder" in refused(capsys, apply.main, *words, "--labels", "a.nii.gz")
    folder = tmp_path / "out"
    assert "is no folder" in refused(capsys, export_poses.main, words[0], "--output", folder, "--format", "itk")
    assert not any(tmp_path.iterdir())


def test_outputs_that_must_not_be_written(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there, text = tmp_path / "there.nii.gz", tmp_path / "there.txt"
    there.write_bytes(b"mine")
    (tmp_path / "folder.nii.gz").mkdir()
    before = {path: path.read_bytes() for path in finished.iterdir()}
    for words, expected in (
        ((there,), "exists already; pass --force"),
        ((text,), "ends in .nii.gz or .nii"),
        ((tmp_path / "folder.nii.gz",), "is a folder"),
        ((tmp_path / "none" / "out.nii.gz",), "there is no folder"),
        ((finished / "volume.nii.gz", "--force"), "is a file of the run"),
        ((there, "--like", there, "--force"), "is an input"),
    ):
        assert expected in refused(capsys, render.main, finished, "--output", *words)
    assert there.read_bytes() == b"mine"
    assert {path: path.read_bytes() for path in finished.iterdir()} == before
    assert render.main([str(finished), "--resolution", "3", "--output", str(there), "--force"]) == 0
    assert there.read_bytes() != b"mine"


def test_a_folder_that_is_not_empty(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    line = refused(capsys, export_poses.main, finished, "--format", "itk", "--output", tmp_path)
    assert "is not empty" in line
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt"}


def test_images_that_are_not_of_the_run(
    subject: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stacks = files(subject, "stack")
    shifted = tmp_path / "shifted.nii.gz"
    affine = np.diag([1.5, 1.5, 4, 1])
    save_volume(shifted, np.zeros((2, 2, 2), np.float32), affine)
    cases = (
        (stacks[:2], "2 images for 3 stacks (stack-0.nii.gz, stack-1.nii.gz, stack-2.nii.gz)"),
        ([stacks[1], stacks[0], stacks[2]], "differs from that of stack-0.nii.gz in the run"),
        ([shifted, *stacks[1:]], "shifted.nii.gz: image grid (2, 2, 2) differs"),
        ([tmp_path / "none.nii.gz", *stacks[1:]], "none.nii.gz: no such file"),
    )
    out = tmp_path / "out"
    for images, expected in cases:
        for option in ("--stacks", "--labels"):
            line = refused(capsys, apply.main, finished, option, *images, "--output", f"{out}.nii.gz")
            assert expected in line
        words = (finished, "--format", "nesvor", "--stacks", *images, "--output", out)
        assert expected in refused(capsys, export_poses.main, *words)
    assert {path.name for path in tmp_path.iterdir()} == {"shifted.nii.gz"}


@pytest.mark.parametrize(
    "words",
    [
        (apply.main, "RUN", "--output", "o.nii.gz"),
        (apply.main, "RUN", "--output", "o.nii.gz", "--labels", "a", "--no-gain"),
        (render.main, "RUN", "--output", "o.nii.gz", "--like", "a", "--resolution", "1"),
        (export_poses.main, "RUN", "--output", "o", "--format", "itk", "--stacks", "a"),
        (export_poses.main, "RUN", "--output", "o", "--format", "fsl"),
    ],
)
def test_options_that_do_not_go_together(
    words: tuple[Callable[[list[str]], int], ...], capsys: pytest.CaptureFixture[str]
) -> None:
    command, *arguments = words
    with pytest.raises(SystemExit) as ended:
        command([str(word) for word in arguments])
    assert ended.value.code == 2
    assert "error:" in capsys.readouterr().err
