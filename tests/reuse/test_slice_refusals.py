"""Refusals of unusable slice folders: one line that names the file, exit code 3, and nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.cli.infer import main
from g3r.errors import InputError
from g3r.reuse.slice_input import load_slice_folder
from tests.reuse.slice_writer import AXIAL, poses, seen, write_slice, write_stack

AFFINES = poses(AXIAL, 11, np.random.default_rng(3))
IMAGE, MASK = seen(AFFINES[5])


def rewrite(folder: Path, name: str = "5", **changed: object) -> None:
    """Rewrite a slice with another image, mask or affine."""
    write_slice(folder, name, **({"affine": AFFINES[5], "image": IMAGE, "mask": MASK} | changed))  # type: ignore[arg-type]


def sheared() -> np.ndarray:
    affine = AFFINES[5].copy()
    affine[:3, 1] += 0.2 * affine[:3, 0]
    return affine


def raw_header(folder: Path, **fields: object) -> None:
    """Write slice 5 with raw header fields."""
    image = nib.Nifti1Image.from_filename(folder / "5.nii.gz")
    for name, value in fields.items():
        image.header[name] = value
    array = np.asarray(image.dataobj)
    new = nib.Nifti1Image(array, None, image.header)
    for name, value in fields.items():
        new.header[name] = value
    nib.save(new, folder / "5.nii.gz")


def stack_of(folder: Path) -> None:
    """A stack with the name of a slice."""
    nib.save(nib.Nifti1Image(np.repeat(IMAGE[:, :, None], 4, 2), AFFINES[5]), folder / "5.nii.gz")


def mask_of(folder: Path, mask: np.ndarray, affine: np.ndarray = AFFINES[5]) -> None:
    nib.save(nib.Nifti1Image(mask[:, :, None].astype(np.float32), affine), folder / "mask_5.nii.gz")


def indexed(*lines: str) -> Callable[[Path], object]:
    """Write an index with our header line, by default with slices 0 to 10 as one stack."""
    rows = lines or tuple(f"{k}\t0\t{k}" for k in range(11))
    return lambda folder: (folder / "index.tsv").write_text("\n".join(["number\tstack\tslice", *rows]) + "\n")


def all_but(folder: Path, *kept: int) -> None:
    for k in range(11):
        if k not in kept:
            (folder / f"{k}.nii.gz").unlink()


def blank_masks(folder: Path) -> None:
    for k, affine in enumerate(AFFINES):
        write_slice(folder, str(k), affine, mask=np.zeros((30, 34), bool))


def one_of_other_pixels(folder: Path) -> None:
    indexed()(folder)
    affine = AFFINES[5].copy()
    affine[:3, 0] *= 1.01
    rewrite(folder, affine=affine)


def not_finite(folder: Path) -> None:
    image = IMAGE.copy()
    image[15, 17] = np.nan
    rewrite(folder, image=image)


FULL = [f"{k}\t0\t{k}" for k in range(11)]

DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no slices": (lambda f: all_but(f), "holds no slice; expected 0.nii.gz, 1.nii.gz"),
    "one slice": (lambda f: all_but(f, 3), "holds a single slice, 3.nii.gz; expected at least 2"),
    "a stack": (stack_of, "5.nii.gz: has shape (30, 34, 4); expected a single slice (I, J, 1), pass stacks"),
    "sheared": (lambda f: rewrite(f, affine=sheared()), "5.nii.gz: axes are sheared (cosine 0.2); expected a rigid"),
    "not finite": (lambda f: raw_header(f, srow_x=[np.nan, 0, 0, 0]), "5.nii.gz: bad header (grid affine must be a"),
    "flat": (lambda f: raw_header(f, srow_z=[0, 0, 0, 0]), "5.nii.gz: bad header (grid affine is sing"),
    "no pose": (lambda f: raw_header(f, sform_code=0, qform_code=0), "5.nii.gz: header holds no orientation"),
    "metres": (lambda f: rewrite(f, affine=AFFINES[5] * [1e-3, 1e-3, 1e-3, 1]), "5.nii.gz: pixels and thickness of"),
    "text": (lambda f: (f / "5.nii.gz").write_text("x"), "5.nii.gz: not a readable NIfTI file"),
    "cut": (lambda f: (f / "5.nii.gz").write_bytes((f / "5.nii.gz").read_bytes()[:400]), "5.nii.gz: "),
    "not a number": (not_finite, "5.nii.gz: 1 values inside the mask are not finite"),
    "mask of another shape": (lambda f: mask_of(f, MASK[1:]), "mask_5.nii.gz: mask grid (29, 34, 1) differs from"),
    "mask elsewhere": (lambda f: mask_of(f, MASK, AFFINES[8]), "mask_5.nii.gz: mask is up to"),
    "mask is an image": (lambda f: mask_of(f, IMAGE), "mask_5.nii.gz: holds values up to"),
    "masks empty": (blank_masks, "no slice shows brain (all masks are empty)"),
    "twice": (lambda f: rewrite(f, name="5.nii", mask=None), "has the number of 5.nii; expected one file for each"),
    "twice by zeros": (lambda f: rewrite(f, name="05", mask=None), "5.nii.gz: has the number of 05.nii.gz"),
    "mask twice": (lambda f: rewrite(f, name="5.nii"), "has the number of "),
    "not in the index": (indexed(*FULL[:-1]), "10.nii.gz: index.tsv has no line for it"),
    "a slice twice": (indexed(*FULL, "11\t0\t3"), "index.tsv: has slice 3 of stack 0 twice"),
    "a number twice": (indexed(*FULL, "3\t0\t30"), "index.tsv: has number 3 twice"),
    "words": (indexed(*FULL, "a\t0\t30"), r"index.tsv: line 'a\t0\t30'; expected number, stack and slice"),
    "below zero": (indexed(*FULL, "11\t0\t-1"), "expected number, stack and slice from 0 on"),
    "endless": (indexed(*FULL, "11\t0\t1000000000"), "index.tsv: slice 1000000000 of stack 0; expected at most 2000"),
    "other pixels": (one_of_other_pixels, "of the same stack 2 x 2 x 3 mm; expected the same"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_folder_that_cannot_be_used(name: str, tmp_path: Path) -> None:
    damage, expected = DAMAGES[name]
    write_stack(tmp_path, AFFINES)
    rewrite(tmp_path)
    load_slice_folder(tmp_path)  # the undamaged folder is usable
    damage(tmp_path)
    with pytest.raises(InputError) as caught:
        load_slice_folder(tmp_path)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_command_says_it_in_one_line_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_stack(tmp_path / "in", AFFINES)
    stack_of(tmp_path / "in")
    for folder, expected in (
        (tmp_path / "in", "5.nii.gz: has shape"),
        (tmp_path / "none", "none: is no folder; expected one of slices"),
        (tmp_path / "in" / "5.nii.gz", "5.nii.gz: is no folder"),
    ):
        assert main(["--slices", str(folder), "--no-prior", "--output", str(tmp_path / "out")]) == 3
        said = capsys.readouterr()
        assert said.out == ""
        (line,) = said.err.splitlines()
        assert line.startswith("g3r-infer: ")
        assert expected in line
    assert {path.name for path in tmp_path.iterdir()} == {"in"}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--stacks", "a.nii.gz"], "argument --stacks: not allowed with argument --slices"),
        (["--dicom", "d"], "argument --dicom: not allowed with argument --slices"),
        (["--masks", "auto"], "--slices excludes --masks: masks are mask_N.nii.gz in the folder"),
        (["--mask-command", "c {stack} {mask}"], "--slices excludes --mask-command"),
        (["--mask-timeout", "5"], "--slices excludes --mask-timeout"),
        (["--mask-ckpt", "m.safetensors"], "--slices excludes --mask-ckpt"),
        (["--whole-image"], "--slices excludes --whole-image: without mask_N.nii.gz pixels above zero are taken"),
        (["--series", "3"], "--slices excludes --series"),
        (["--keep-header-text"], "--slices excludes --keep-header-text"),
        (["--dicom-out", "d", "--dicom-reference", "e"], "--slices excludes --dicom-out"),
        (["--keep-poses", "--config", "run.json"], "--config and --keep-poses exclude each other"),
    ],
)
def test_options_that_do_not_go_together(words: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--slices", "in", "--output", "out", *words])
    assert ended.value.code == 2
    assert expected in capsys.readouterr().err.splitlines()[-1]


def test_kept_poses_need_given_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--stacks", "a.nii.gz", "--keep-poses", "--output", "out"])
    assert "--keep-poses is for --slices" in capsys.readouterr().err
