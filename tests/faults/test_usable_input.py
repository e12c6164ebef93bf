"""Unusual but usable input: accepted, read correctly, with a warning where a user should know."""

from __future__ import annotations

import gzip
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.brain_mask import whole_image
from g3r.acquisition.stacks import load_stack
from g3r.cli.infer import main
from tests.faults.bad_files import header, moved, only_sform
from tests.faults.commands import run
from tests.faults.nifti_files import AFFINE, SHAPE, ball, image, raw, write, write_raw
from tests.tally import Tally

pytestmark = pytest.mark.usefixtures("networks_once")

Maker = Callable[[Path], Path]


def oblique(spacing: tuple[float, float, float] = (1, 1, 3)) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix() * spacing
    affine[:3, 3] = (-30, 12, 5)
    return affine


def typed(dtype: Any, slope: float = 1.0, inter: float = 0.0) -> Maker:
    """The good image rounded and stored as a type with a scaling; its values are those of `image`."""

    def make(folder: Path) -> Path:
        stored = np.rint((image() - inter) / slope).astype(dtype)
        fields = {"scl_slope": slope, "scl_inter": inter}
        return write_raw(folder / "odd.nii.gz", stored, fields)

    return make


def big_endian(folder: Path) -> Path:
    made = nib.Nifti1Image(image(), AFFINE, nib.Nifti1Header(endianness=">"))
    (folder / "odd.nii").write_bytes(made.to_bytes())
    return folder / "odd.nii"


def as_pair(folder: Path) -> Path:
    nib.save(nib.Nifti1Pair(image(), AFFINE), folder / "odd.hdr")
    return folder / "odd.img"


def linked(folder: Path) -> Path:
    write(folder / "there.nii.gz")
    (folder / "odd.nii.gz").symlink_to("there.nii.gz")
    return folder / "odd.nii.gz"


def in_members(folder: Path) -> Path:
    """A concatenation of gzip members, as written by pigz and bgzip."""
    whole = raw()
    (folder / "odd.nii.gz").write_bytes(gzip.compress(whole[:5000]) + gzip.compress(whole[5000:]))
    return folder / "odd.nii.gz"


def nan_around(folder: Path) -> Path:
    data = image()
    data[ball() == 0] = np.nan
    return write(folder / "odd.nii.gz", data)


QFORM = {"sform_code": 0, "qform_code": 1}
DENSE = AFFINE @ np.diag([1.0, 1.0, 0.34, 1.0])
THIN = AFFINE @ np.diag([2.0, 2.0, 0.3, 1.0])

STACKS: dict[str, tuple[Maker, str]] = {
    # storage
    "uint8": (typed(np.uint8, 4.0, 100.0), ""),
    "int16": (typed(np.int16), ""),
    "int16 with a scaling": (typed(np.int16, 0.05, -20.0), ""),
    "int16 with a negative slope": (typed(np.int16, -0.1, 3.0), ""),
    "uint16": (typed(np.uint16), ""),
    "int32": (typed(np.int32), ""),
    "int64": (typed(np.int64), ""),
    "float64": (typed(np.float64), ""),
    "infinite slope": (header("odd.nii.gz", scl_slope=np.inf), ""),
    "big-endian": (big_endian, ""),
    "NIfTI-2": (lambda folder: write_raw(folder / "odd.nii", version=2), ""),
    "header and voxels apart": (as_pair, ""),
    "one frame": (lambda folder: write(folder / "odd.nii.gz", image()[..., None]), ""),
    "frames of one": (lambda folder: write(folder / "odd.nii.gz", image().reshape(*SHAPE, 1, 1, 1)), ""),
    "an extension": (lambda folder: write_raw(folder / "odd.nii.gz", extensions=((6, b"hello"),)), ""),
    "an unknown extension": (lambda folder: write_raw(folder / "odd.nii", extensions=((77, b"x" * 99),)), ""),
    "bytes behind the voxels": (
        lambda folder: write_raw(folder / "odd.nii.gz", cut=lambda whole: whole + bytes(1000)),
        "",
    ),
    "gzip members": (in_members, ""),
    "header size 0": (header("odd.nii", sizeof_hdr=0), "sizeof_hdr should be 348"),
    "wrong bits a voxel": (header("odd.nii", bitpix=7), ""),
    # names
    "upper case": (lambda folder: write(folder / "ODD.NII.GZ"), ""),
    "spaces": (lambda folder: write(folder / "odd  one (2).nii.gz"), ""),
    "not ASCII": (lambda folder: write(folder / "Kopf Schicht ä 頭.nii.gz"), ""),
    "a line break": (lambda folder: write(folder / "odd\none.nii.gz"), ""),
    "begins with a dot": (lambda folder: write(folder / ".nii.gz"), ""),
    "a link": (linked, ""),
    # location and geometry
    "oblique": (lambda folder: write(folder / "odd.nii.gz", image(), oblique()), ""),
    "left-handed": (lambda folder: write(folder / "odd.nii.gz", image(), oblique((1, 1, -3))), ""),
    "negative spacings": (lambda folder: write(folder / "odd.nii.gz", image(), oblique((-1, -1, -3))), ""),
    "10 m from the origin": (lambda folder: write(folder / "odd.nii.gz", image(), moved(0, 1e4, 0)), ""),
    "slices on the first axis": (
        lambda folder: write(folder / "odd.nii.gz", image(shape=(8, 24, 20)), np.diag([3.0, 1, 1, 1])),
        "",
    ),
    "no orientation": (header("odd.nii.gz", sform_code=0, qform_code=0), "header holds no orientation"),
    "qform alone": (header("odd.nii.gz", **QFORM), ""),
    "sform and qform apart": (
        header("odd.nii.gz", **only_sform(moved(0, 0, 20)) | {"qform_code": 1}),
        "sform and qform differ by up to 20 mm; the sform is used",
    ),
    "a qform that cannot be read": (
        header("odd.nii.gz", qform_code=1, quatern_b=2.0),
        "the qform cannot be read; the sform is used",
    ),
    "qfac 0": (header("odd.nii.gz", **QFORM, pixdim=[0, 1, 1, 3, 0, 0, 0, 0]), ""),
    "negative pixdim": (header("odd.nii.gz", **QFORM, pixdim=[1, -1, 1, 3, 0, 0, 0, 0]), "pixdim.* should be positive"),
    "pixdim 0 under an sform": (
        header("odd.nii.gz", qform_code=0, pixdim=[1, 0, 0, 0, 0, 0, 0, 0]),
        "pixdim.* should be non-zero",
    ),
    # content
    "500 slices": (
        lambda folder: write(folder / "odd.nii.gz", image(shape=(24, 20, 500)), DENSE),
        "spacings do not tell (1 x 1 x 1.02 mm), nor does its header; name the axis there",
    ),
    "slices thinner than pixels": (
        lambda folder: write(folder / "odd.nii.gz", image(), THIN),
        "thickness 0.9 mm is less than the pixels' 2 x 2 mm; check --thickness",
    ),
    "two slices": (lambda folder: write(folder / "odd.nii.gz", image(shape=(24, 20, 2))), ""),
    "NaN around the head": (nan_around, ""),
    "negative around the head": (
        lambda folder: write(folder / "odd.nii.gz", np.where(ball() > 0, image(), -image())),
        "",
    ),
    "faint": (lambda folder: write(folder / "odd.nii.gz", image() * np.float32(1e-9)), ""),
    "bright": (lambda folder: write(folder / "odd.nii.gz", image() * np.float32(1e20)), ""),
}

USUAL = "thickness taken as the distance of slices"
"""Warning for every image without a sidecar."""

AS_GOOD = ("one frame", "frames of one", "gzip members", "NIfTI-2", "big-endian", "header and voxels apart")


@pytest.mark.parametrize("name", STACKS)
def test_an_odd_stack(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, tally: Tally) -> None:
    make, remark = STACKS[name]
    path = make(tmp_path)
    with tally.case(), caplog.at_level(logging.WARNING):
        outcome = run(main, ["--stacks", path, "--output", tmp_path / "out", "--dry-run", "--whole-image"], tmp_path)
        assert outcome.code == 0, outcome.err
        assert outcome.changed == set()
        remarks = [line for line in caplog.messages if USUAL not in line]
        assert len(remarks) == bool(remark), remarks
        if remark:
            assert path.name in remarks[0]
            assert remark.split(".*")[-1] in remarks[0]
        stack = load_stack(path, whole_image)
        if name in AS_GOOD:
            np.testing.assert_array_equal(stack.image, image())
        if name.startswith(("uint", "int", "float")) and "slope" not in name:
            np.testing.assert_allclose(stack.image, image(), atol=2.1 if name == "uint8" else 0.6)


def test_a_negative_slope_is_applied(tmp_path: Path, tally: Tally) -> None:
    with tally.case():
        stack = load_stack(STACKS["int16 with a negative slope"][0](tmp_path), whole_image)
        np.testing.assert_allclose(stack.image, image(), atol=0.06)


MASKS: dict[str, tuple[Callable[[], tuple[np.ndarray, np.ndarray]], str]] = {
    "of every voxel": (lambda: (np.ones(SHAPE, np.uint8), AFFINE), "its mask marks every voxel"),
    "of a probability": (lambda: (ball() * np.float32(0.9), AFFINE), ""),
    "that overshoots": (lambda: (ball() * np.float32(1.07), AFFINE), ""),
    "of 0 and 255": (lambda: (ball() * np.uint8(255), AFFINE), ""),
    "of labels": (lambda: (ball() * np.arange(1, 9, dtype=np.int16), AFFINE), ""),
    "of floats": (lambda: (ball().astype(np.float64), AFFINE), ""),
    "with NaN outside": (lambda: (np.where(ball() > 0, 1, np.nan).astype(np.float32), AFFINE), ""),
    "of one frame": (lambda: (ball()[..., None], AFFINE), ""),
    "off by a hair": (lambda: (ball(), moved(1e-4, -1e-4, 1e-4)), ""),
    "off by 0.4 voxels": (lambda: (ball(), moved(0.4, 0, 0)), ""),
}


@pytest.mark.parametrize("name", MASKS)
def test_an_odd_mask_is_read_right(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, tally: Tally) -> None:
    data, affine = MASKS[name][0]()
    stack, mask = write(tmp_path / "stack.nii.gz"), write(tmp_path / "mask.nii.gz", data, affine)
    with tally.case(), caplog.at_level(logging.WARNING):
        line = ["--stacks", stack, "--masks", mask, "--thickness", "3", "--output", tmp_path / "out", "--dry-run"]
        outcome = run(main, line, tmp_path)
        assert outcome.code == 0, outcome.err
        assert [MASKS[name][1] in one for one in caplog.messages] == [True] * bool(MASKS[name][1])
        expected = np.ones(SHAPE, bool) if name == "of every voxel" else ball() > 0
        found = load_stack(stack, mask)
        np.testing.assert_array_equal(found.mask, expected)
        assert [MASKS[name][1] in one for one in found.remarks] == [True] * bool(MASKS[name][1])  # for the verdict


def test_twelve_stacks(tmp_path: Path, tally: Tally) -> None:
    paths = [write(tmp_path / f"{n}.nii.gz", image(n), moved(n, 0, 0)) for n in range(12)]
    with tally.case():
        outcome = run(main, ["--stacks", *paths, "--whole-image", "--output", tmp_path / "out", "--dry-run"], tmp_path)
        assert outcome.code == 0, outcome.err
        assert outcome.out.count("thickness 3 mm") == 12


@pytest.mark.parametrize("kind", ["new", "deep", "empty", "spaces and more ä", "earlier result"])
def test_a_new_empty_or_forced_output_folder_is_accepted(kind: str, tmp_path: Path, tally: Tally) -> None:
    folder = tmp_path / "a" / "b" / "c" if kind == "deep" else tmp_path / kind
    options: list[str] = []
    if kind in ("empty", "earlier result"):
        folder.mkdir()
    if kind == "earlier result":
        for name in ("volume.nii.gz", "run.json"):
            (folder / name).write_text("earlier")
        options = ["--force"]
    with tally.case():
        line = ["--stacks", write(tmp_path / "s.nii"), "--whole-image", "--output", folder, "--dry-run", *options]
        assert run(main, line, tmp_path).code == 0


def test_names_that_are_no_text_as_a_process(tmp_path: Path, tally: Tally) -> None:
    """Names of stack and output have bytes that are not UTF-8, with an ASCII terminal."""
    name = os.fsencode(tmp_path) + b"/kopf-\xe4\xff.nii.gz"
    Path(os.fsdecode(name)).write_bytes(write(tmp_path / "a.nii.gz").read_bytes())
    line: list[str | bytes] = [
        sys.executable,
        "-m",
        "g3r.cli.infer",
        "--stacks",
        name,
        "--whole-image",
        "--output",
        name + b".out",
        "--dry-run",
    ]
    environment = os.environ | {"PYTHONIOENCODING": "ascii:strict"}
    with tally.case():
        done = subprocess.run(line, capture_output=True, check=False, env=environment)
        assert done.returncode == 0, done.stderr
        assert b"thickness 3 mm" in done.stdout
        assert b"Traceback" not in done.stderr
