"""Refusals of `g3r-infer`: bad input with exit code 3, bad options with 2, each in one line."""

import gzip
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r import GaussianReconstructor
from g3r.cli.infer_options import parsed_options
from g3r.errors import InputError
from g3r.planning.presets import PRESETS, ReconstructionSettings
from tests.acquisition.nifti_files import stacks_of_two
from tests.cli.test_infer import files, inputs, run


def bad_command(kind: str, subject: Path, folder: Path) -> tuple[list[object], str]:
    """Arguments that must be refused, and a name that the message must contain."""
    stacks, masks = files(subject, "stack"), files(subject, "mask")
    image = nib.Nifti1Image.from_filename(stacks[0])
    data, bad = np.asarray(image.dataobj), folder / "bad.nii.gz"
    options: list[object] = ["--no-prior", "--thickness", "4", "--output", folder / "out"]
    if kind == "missing file":
        return ["--stacks", stacks[0], bad, "--whole-image", *options], "bad.nii.gz"
    if kind == "text file":
        bad.write_text("hello\n")
    elif kind == "cut off":
        bad.write_bytes(stacks[0].read_bytes()[: stacks[0].stat().st_size // 2])
    elif kind == "cut off after the header":
        bad.write_bytes(gzip.compress(gzip.decompress(stacks[0].read_bytes())[:1000]))
    elif kind == "one slice":
        nib.save(nib.Nifti1Image(data[:, :, :1], image.affine), bad)
    elif kind == "NaN volume":
        nib.save(nib.Nifti1Image(np.full(data.shape, np.nan, np.float32), image.affine), bad)
    elif kind == "mask of another grid":
        return ["--stacks", stacks[0], "--masks", masks[1], *options], "mask-1.nii.gz"
    elif kind == "empty mask":
        nib.save(nib.Nifti1Image(np.zeros(data.shape, np.uint8), image.affine), bad)
        return ["--stacks", *stacks, "--masks", masks[0], masks[1], _like(bad, stacks[2]), *options], "bad.nii.gz"
    elif kind == "thickness zero":
        return [*inputs(subject), *options[:1], "--thickness", "0", *options[3:]], "stack-0.nii.gz"
    elif kind == "checkpoint is text":
        (folder / "prior.pt").write_text("not a checkpoint\n")
        return [*inputs(subject), "--ckpt", folder / "prior.pt", *options[1:]], "prior.pt"
    elif kind == "output is a file":
        (folder / "out").write_text("mine")
        return [*inputs(subject), *options], "out"
    elif kind == "resolution":
        return [*inputs(subject), *options, "--resolution", "0"], "resolution 0 mm"
    whole = kind in ("one slice", "NaN volume")
    return ["--stacks", bad, *(["--whole-image"] if whole else ["--masks", masks[0]]), *options], "bad.nii.gz"


def _like(path: Path, image_path: Path) -> Path:
    """An empty mask on the grid of an image."""
    image = nib.Nifti1Image.from_filename(image_path)
    nib.save(nib.Nifti1Image(np.zeros(image.shape, np.uint8), image.affine), path)
    return path


@pytest.mark.parametrize(
    "kind",
    [
        "missing file",
        "text file",
        "cut off",
        "cut off after the header",
        "one slice",
        "NaN volume",
        "mask of another grid",
        "empty mask",
        "thickness zero",
        "checkpoint is text",
        "output is a file",
        "resolution",
    ],
)
def test_bad_input_is_refused_in_one_line_with_exit_code_3(kind: str, subject: Path, tmp_path: Path) -> None:
    arguments, name = bad_command(kind, subject, tmp_path)
    before = {path.name for path in tmp_path.iterdir()}
    done = run("infer", *arguments)
    assert done.returncode == 3, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("g3r-infer: ")
    assert name in lines[0]
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--stacks", "a.nii.gz"],
        ["--stacks", "a.nii.gz", "--output", "o", "--preset", "best"],
        ["--stacks", "a.nii.gz", "b.nii.gz", "--masks", "m.nii.gz", "--output", "o"],
        ["--stacks", "a.nii.gz", "b.nii.gz", "c.nii.gz", "--thickness", "1", "2", "--output", "o"],
        ["--stacks", "a.nii.gz", "--output", "o", "--threads", "0"],
        ["--stacks", "a.nii.gz", "--output", "o", "--time-budget", "0"],
        ["--stacks", "a.nii.gz", "--output", "o", "--time-budget", "nan"],
        ["--stacks", "a.nii.gz", "--output", "o", "--time-budget", "20", "--preset", "preview"],
        ["--stacks", "a.nii.gz", "--output", "o", "--ckpt", "p.pt", "--no-prior"],
        ["--stacks", "a.nii.gz", "--output", "o", "--resolution", "fine"],
    ],
)
def test_usage_errors_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from g3r.cli.infer import main

    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage: g3r-infer" in capsys.readouterr().err


def test_an_unknown_preset_is_refused_with_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    from g3r.cli.infer import main

    with pytest.raises(SystemExit):
        main(["--stacks", "a.nii.gz", "--output", "o", "--preset", "draft"])
    line = capsys.readouterr().err.splitlines()[-1]
    assert all(name in line for name in ("'draft'", *PRESETS))


def test_a_missing_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.pt"):
        GaussianReconstructor(tmp_path / "absent.pt")


@pytest.mark.parametrize("settings", ["best", replace(PRESETS["preview"], resolution_mm=5.0, use_prior=False)])
def test_settings_without_meaning_are_refused(settings: ReconstructionSettings | str) -> None:
    with pytest.raises(InputError, match="expected"):
        GaussianReconstructor(settings=settings)


def test_python_refuses_stacks_that_are_not_of_one_head_as_the_command_does() -> None:
    first, second = stacks_of_two()
    affine = second.affine.copy()
    affine[:3, 3] += 1500
    reconstructor = GaussianReconstructor(settings="preview")
    for call in (reconstructor.reconstruct, reconstructor.register_stacks):
        with pytest.raises(InputError, match=r"^first \(stack 3\): holds the same image as first \(stack 1\); "):
            call([first, second, first])
        with pytest.raises(InputError, match=r"^second: is 2\d\d\d mm from first by its header; expected scans of one"):
            call([first, replace(second, affine=affine)])


def test_a_usage_error_as_a_process() -> None:
    done = run("infer", "--stacks")
    assert done.returncode == 2
    assert done.stderr.startswith("usage: g3r-infer")


@pytest.mark.parametrize(("weights", "code"), [("mine.safetensors", 2), ("cc0", None)])
def test_a_preview_takes_no_prior_of_the_user(
    weights: str, code: int | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """The name of a set chooses the atlas template as well, which a preview uses."""
    words = ["--stacks", "a.nii", "--output", "out", "--preset", "preview", "--ckpt", weights]
    if code is None:
        assert parsed_options(words).ckpt == weights
        return
    with pytest.raises(SystemExit) as ended:
        parsed_options(words)
    assert ended.value.code == code
    assert "--ckpt and --preset preview exclude each other" in capsys.readouterr().err
