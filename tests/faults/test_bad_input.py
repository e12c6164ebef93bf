"""Stacks, masks, folders and options that `g3r-infer` must refuse, each with its own message."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from g3r.cli.infer import main
from tests.faults.bad_files import BAD_MASKS, BAD_STACKS, moved
from tests.faults.commands import assert_refused, run
from tests.faults.nifti_files import AFFINE, ball, image, write
from tests.tally import Tally

REFUSES = "g3r-infer"


pytestmark = pytest.mark.usefixtures("networks_once")


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    return write(tmp_path / "stack.nii.gz")


@pytest.mark.parametrize("name", BAD_STACKS)
def test_a_bad_stack(name: str, stack: Path, tmp_path: Path, tally: Tally) -> None:
    """Alone, and as the second of two, where the message must not name the other one."""
    make, says = BAD_STACKS[name]
    (tmp_path / "bad files").mkdir()
    bad = make(tmp_path / "bad files")
    named = bad.name.replace("\0", "\\x00")
    # if one stack has no usable slice, the others are used, with a warning (tests/pipeline)
    for stacks in [[bad]] if name == "one pixel" else [[bad], [stack, bad]]:
        with tally.case() as case:
            outcome = run(main, ["--stacks", *stacks, "--whole-image", "--output", tmp_path / "out"], tmp_path)
            assert_refused(outcome, REFUSES, named, says)
            case.refused()


@pytest.mark.parametrize("name", BAD_MASKS)
def test_a_bad_mask(name: str, stack: Path, tmp_path: Path, tally: Tally) -> None:
    make, says = BAD_MASKS[name]
    (tmp_path / "masks").mkdir()
    bad = make(tmp_path / "masks")
    with tally.case() as case:
        line = ["--stacks", stack, "--masks", bad, "--output", tmp_path / "out"]
        outcome = run(main, line, tmp_path)
        assert_refused(outcome, REFUSES, "stack.nii.gz" if "12 masked" in says else bad.name, says)
        case.refused()


def pairs(folder: Path) -> dict[str, tuple[list[Path], str, str]]:
    """Stacks that are good alone but not together: files, the file to be named, the message."""
    first = folder / "stack.nii.gz"
    (folder / "link.nii.gz").symlink_to(first)
    (folder / "copy.nii.gz").write_bytes(first.read_bytes())
    turned = write(folder / "turned.nii.gz", image(), AFFINE @ np.diag([-1.0, 1, 1, 1]))
    far = write(folder / "far.nii.gz", image(1), moved(0, 0, 10_000))
    second = write(folder / "second.nii.gz", image(1))
    other_way = folder / "." / ".." / folder.name / "stack.nii.gz"
    return {
        "the same file twice": ([first, first], "stack.nii.gz", "is given twice; pass each stack once"),
        "the same file by another way": ([first, other_way], "stack.nii.gz", "is given twice"),
        "the same file as the third": ([first, second, first], "stack.nii.gz", "is given twice"),
        "a link to it": ([first, folder / "link.nii.gz"], "link.nii.gz", "is given twice"),
        "a copy of it": ([first, folder / "copy.nii.gz"], "copy.nii.gz", "same image as stack.nii.gz"),
        "its image with another header": ([first, turned], "turned.nii.gz", "same image as stack.nii.gz"),
        "10 m away": ([first, far], "far.nii.gz", "is 10000 mm from stack.nii.gz"),
    }


PAIRS = (
    "the same file twice",
    "the same file by another way",
    "the same file as the third",
    "a link to it",
    "a copy of it",
    "its image with another header",
    "10 m away",
)


@pytest.mark.parametrize("name", PAIRS)
def test_stacks_that_do_not_go_together(name: str, stack: Path, tmp_path: Path, tally: Tally) -> None:
    stacks, names, says = pairs(tmp_path)[name]
    with tally.case() as case:
        outcome = run(main, ["--stacks", *stacks, "--whole-image", "--output", tmp_path / "out"], tmp_path)
        assert_refused(outcome, REFUSES, names, says)
        case.refused()


def no_entry(folder: Path) -> Path:
    path = folder / "closed"
    path.mkdir()
    path.chmod(0o555)
    return path / "out"


def occupied(folder: Path) -> Path:
    (folder / "out").mkdir()
    (folder / "out" / "notes.txt").write_text("mine")
    return folder / "out"


def file_at(folder: Path) -> Path:
    (folder / "out").write_text("mine")
    return folder / "out"


def below_a_file(folder: Path) -> Path:
    return file_at(folder) / "deep" / "out"


def link_to(target: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / "out").symlink_to(target)
        return folder / "out"

    return make


OUTPUTS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "holds files": (occupied, "is not empty; pass --force"),
    "is a file": (file_at, "is a file; expected a folder"),
    "is below a file": (below_a_file, "out is a file; expected a folder"),
    "is a link to nothing": (link_to("nowhere"), "is a link to nothing; remove it"),
    "is a link to itself": (link_to("out"), "is a link to nothing|cannot be written"),
    "is a link to a file": (link_to("stack.nii.gz"), "is a file; expected a folder"),
    "has a name too long": (lambda folder: folder / ("out" * 100), "cannot be written"),
    "has a zero byte": (lambda folder: folder / "out\0", "cannot be written"),
    "cannot be written": (no_entry, "cannot be written; choose another --output"),
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_that(name: str, stack: Path, tmp_path: Path, tally: Tally, monkeypatch: pytest.MonkeyPatch) -> None:
    make, says = OUTPUTS[name]
    folder = make(tmp_path)
    if name == "cannot be written" and os.access(folder.parent, os.W_OK):  # to root everything is open
        allowed = os.access
        monkeypatch.setattr(os, "access", lambda path, mode: "closed" not in str(path) and allowed(path, mode))
    with tally.case() as case:
        outcome = run(main, ["--stacks", stack, "--whole-image", "--output", folder], tmp_path)
        assert_refused(outcome, REFUSES, "out", says)
        case.refused()


def test_force_takes_no_folder_for_a_result_that_holds_none(stack: Path, tmp_path: Path, tally: Tally) -> None:
    """Another program's mask.nii.gz is not ours to replace."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mask.nii.gz").write_text("mine")
    with tally.case() as case:
        outcome = run(main, ["--stacks", stack, "--whole-image", "--output", tmp_path / "out", "--force"], tmp_path)
        assert_refused(
            outcome, REFUSES, "out", "holds mask.nii.gz, but no run.json of a result of g3r; choose another --output"
        )
        assert (tmp_path / "out" / "mask.nii.gz").read_text() == "mine"
        case.refused()


@pytest.mark.parametrize("role", ["stack", "mask", "link"])
def test_an_input_is_never_in_the_way_of_an_output(role: str, tmp_path: Path, tally: Tally) -> None:
    """With --force a folder may be replaced, but not if input is read from it."""
    stack = write(tmp_path / ("volume.nii.gz" if role == "stack" else "stack.nii.gz"))
    mask = write(tmp_path / ("mask.nii.gz" if role == "mask" else "brain.nii.gz"), ball())
    folder = tmp_path
    if role == "link":
        folder = tmp_path / "link"
        folder.symlink_to(tmp_path)
        mask = write(tmp_path / "mask.nii.gz", ball())
    with tally.case() as case:
        line = ["--stacks", stack, "--masks", mask, "--output", folder, "--force"]
        outcome = run(main, line, tmp_path)
        assert_refused(outcome, REFUSES, "", "would be replaced by a result of its name; choose another --output")
        case.refused()


VALUES = {
    "--thickness 0": "stack.nii.gz: slice thickness 0 mm",
    "--thickness -3": "stack.nii.gz: slice thickness -3 mm",
    "--thickness nan": "stack.nii.gz: slice thickness nan mm",
    "--thickness inf": "stack.nii.gz: slice thickness inf mm",
    "--thickness 0.01": "expected 0.1 to 20 mm, pass --thickness",
    "--thickness 1e300": "expected 0.1 to 20 mm, pass --thickness",
    "--resolution 0": "resolution 0 mm; expected 0.3 to 3 mm",
    "--resolution -1": "resolution -1 mm; expected 0.3 to 3 mm",
    "--resolution nan": "resolution nan mm; expected 0.3 to 3 mm",
    "--resolution inf": "resolution inf mm; expected 0.3 to 3 mm",
    "--resolution 0.0001": "resolution 0.0001 mm; expected 0.3 to 3 mm",
    "--threads 1000000": "this machine offers .*; choose at most that",
    "--max-memory 1M": "needs at least .*; choose a coarser --resolution",
    "--tensorboard stack.nii.gz": "stack.nii.gz: is a file; expected a folder",
    "--tensorboard out/board": "lies in out, which is put in place at its end; choose another folder for --tensorboard",
    "--tensorboard out": "out: is written while the run goes on, and lies in out",
    "--tensorboard out.unfinished/board": "lies in out.unfinished",
}


@pytest.mark.parametrize("option", VALUES)
def test_a_value_without_meaning(
    option: str, stack: Path, tmp_path: Path, tally: Tally, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name, value = option.split()
    with tally.case() as case:
        outcome = run(main, ["--stacks", stack, "--whole-image", "--output", "out", f"{name}={value}"], tmp_path)
        assert_refused(outcome, REFUSES, "", VALUES[option])
        case.refused()


USAGE = [
    [],
    ["--output", "out"],
    ["--stacks"],
    ["--stacks", "a.nii"],
    ["--stacks", "a.nii", "--output"],
    ["--masks", "m.nii"],
    ["--masks", "m.nii", "m.nii", "m.nii"],
    ["--thickness", "1", "2"],
    ["--thickness", "thick"],
    ["--seed", "-1"],
    ["--seed", "1.5"],
    ["--threads", "0"],
    ["--threads", "-1"],
    ["--resolution", "fine"],
    ["--preset", "best"],
    ["--space", "outer"],
    ["--device", "tpu"],
    ["--time-budget", "0"],
    ["--time-budget", "inf"],
    ["--max-memory", "lots"],
    ["--max-memory", "-1G"],
    ["--ckpt", "p.pt", "--no-prior"],
    ["--preset", "preview", "--time-budget", "9"],
    ["--whole-image", "--masks", "m.nii", "auto"],
    ["--whole-image", "--mask-command", "m {stack} {mask}"],
    ["--mask-command", "m {stack}"],
    ["--mask-timeout", "5"],
    ["--mask-command", "m {stack} {mask}", "--mask-timeout", "0"],
    ["--nonsense"],
]


@pytest.mark.parametrize("words", USAGE, ids=" ".join)
def test_wrong_usage(words: list[str], tmp_path: Path, tally: Tally) -> None:
    """Options are checked before files, which do not exist here."""
    two = ["--stacks", "a.nii", "b.nii", "--output", "out"]
    whole = words if not words or words[0] in ("--output", "--stacks") else [*two, *words]
    if words and words[0] == "--thickness" and len(words) == 3:
        whole = ["--stacks", "a.nii", "b.nii", "c.nii", "--output", "out", *words]
    with tally.case() as case:
        outcome = run(main, whole, tmp_path)
        assert outcome.code == 2
        assert outcome.err.startswith("usage: g3r-infer")
        assert outcome.changed == set()
        case.refused()
