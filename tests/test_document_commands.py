"""Every command in README.md and docs/ parses; reconstructions are tried with stand-ins for the files."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from tests.document_commands import (
    OTHERS,
    Shown,
    all_commands,
    blocks,
    check_make,
    check_training,
    commands,
    main_of,
    parse,
    scripts,
)
from tests.rooms import REPOSITORY

SHOWN = list({one.line: one for one in reversed(all_commands())}.values())[::-1]
PLANES = ("ax", "cor", "sag")
NETWORKS = ("prior", "pose", "mask")
STAND_INS = {
    "DICOM",
    "DIR",
    "nesvor",
    *(f"{plane}{mask}.nii.gz" for plane in PLANES for mask in ("", "-mask")),
    *(f"case/{name}-{n}.nii.gz" for name in ("stack", "mask") for n in range(3)),
    *(f"{network}.safetensors" for network in NETWORKS),
}
"""Files in `folder`."""


def name_of(one: Shown) -> str:
    return f"{one.document}: {one.line}"


@pytest.fixture(scope="module")
def folder(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stand-ins: small brain-extracted stacks, masks, the same as DICOM, slices with poses, weights."""
    from tests.dicom.dicom_files import Study
    from tests.reuse.slice_writer import write_three

    folder = tmp_path_factory.mktemp("stand-ins")
    shutil.copytree(subject, folder / "case")
    (folder / "DICOM").mkdir()
    study = Study(folder / "DICOM")
    for n, name in enumerate(PLANES):
        image = nib.Nifti1Image.from_filename(subject / f"stack-{n}.nii.gz")
        mask = nib.Nifti1Image.from_filename(subject / f"mask-{n}.nii.gz")
        data = np.asarray(image.dataobj) * (np.asarray(mask.dataobj) > 0)
        nib.save(nib.Nifti1Image(data, image.affine), folder / f"{name}.nii.gz")
        shutil.copy(subject / f"mask-{n}.nii.gz", folder / f"{name}-mask.nii.gz")
        study.write(data, image.affine, 3 + 2 * n)
    for name in NETWORKS:
        shutil.copy(REPOSITORY / "g3r" / "checkpoints" / "weights" / f"{name}.safetensors", folder)
    write_three(folder / "nesvor" / "slices", np.random.default_rng(1))
    (folder / "DIR").symlink_to(folder / "DICOM")
    assert all((folder / name).exists() for name in STAND_INS)
    return folder


def inputs(words: list[str]) -> list[str]:
    """Words of a line of `g3r-infer` that name input files."""
    ends = (".nii.gz", ".safetensors")
    beside = [words[words.index(option) + 1] for option in ("--dicom", "--slices", "--config") if option in words]
    return [word for word in words if word.endswith(ends)] + beside


RECONSTRUCTIONS = [
    one
    for one in SHOWN
    if one.line.startswith("g3r-infer ")
    and inputs(one.words)
    and STAND_INS.issuperset(inputs(one.words))
    and "--resume" not in one.line
]


FRESH_BYTES = 400_000_000
"""Memory of g3r-infer, including torch, when it plans its memory."""


@pytest.mark.parametrize("one", SHOWN, ids=name_of)
def test_a_command_is_understood(one: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    if one.is_synopsis:
        assert one.words[0] in scripts()
        return
    words = one.words
    if words[0] == "make":
        check_make(words)
    elif words[0] == "g3r-pretrain":
        check_training(words)
    elif words[0] in scripts() and "--version" in words:
        with pytest.raises(SystemExit, match="0"):
            main_of(words[0])(words[1:])
    elif words[0] in scripts():
        parse(words, monkeypatch)
    elif words[0].rsplit("/")[-1] in ("python", "python3"):
        path = words[2].replace(".", "/") + ".py" if words[1] == "-m" else words[1]
        assert words[2] == "venv" or words[1] == "-c" or (REPOSITORY / path).is_file(), one.line
    else:
        assert words[0] in OTHERS, f"{one.document}: {one.line}"


@pytest.mark.parametrize("one", RECONSTRUCTIONS, ids=name_of)
def test_a_reconstruction_could_begin(
    one: Shown, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With --dry-run the line reads files, finds masks, loads weights and plans memory."""
    words = one.words
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    for option in {"--output", "--dicom-out"} & set(words):
        (tmp_path / words[words.index(option) + 1]).unlink(missing_ok=True)
    monkeypatch.chdir(tmp_path)
    # as in a fresh command, since this process holds leftovers of other tests
    monkeypatch.setattr("g3r.planning.memory_estimate.held_bytes", lambda: FRESH_BYTES)
    dry = [] if "--dry-run" in words else ["--dry-run"]
    assert main_of("g3r-infer")([*words[1:], *dry]) == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    assert "GB" in said
    assert not (tmp_path / "out").exists()


def test_most_reconstructions_are_tried() -> None:
    others = [one.line for one in SHOWN if one.line.startswith("g3r-infer ") and one not in RECONSTRUCTIONS]
    assert all(re.search("--version|--resume|--config|A B C", line) for line in others), others
    assert {"README.md", "docs/first-volume.md", "docs/troubleshooting.md"} <= {one.document for one in RECONSTRUCTIONS}


def test_commands_are_found_in_all_kinds_of_blocks() -> None:
    text = (
        "word\n\n    make test   # why\n    y = a + b\n\n```bash\ng3r-infer --stacks a \\\n    --output b\nls\n```\n\n"
        "```python\nmake = 1\n```\n- item\n"
    )
    assert [one.line for one in commands("x", text)] == ["make test", "g3r-infer --stacks a --output b", "ls"]
    assert [language for language, _ in blocks(text)] == ["", "bash", "python"]


@pytest.mark.parametrize("line", ["g3r-infer --stakcs a --output b", "g3r-render", "g3r-bids a b group -- --what"])
def test_a_command_that_is_wrong_is_noticed(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="2"):
        parse(shlex.split(line), monkeypatch)
    for wrong in ("make nothing", "make study-no.thing", "make test NOTHING=1"):
        with pytest.raises(AssertionError):
            check_make(wrong.split())
