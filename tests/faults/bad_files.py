"""Files that are not valid stacks, and files that are not valid masks of the good stack: name to (maker, message).

A maker gets an empty folder and returns the file; the message is a pattern that the refusal must match.
"""

from __future__ import annotations

import bz2
import gzip
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np

from tests.faults.nifti_files import AFFINE, SHAPE, ball, image, raw, write, write_raw

Maker = Callable[[Path], Path]


def header(name: str = "bad.nii.gz", **fields: Any) -> Maker:
    """A file with header fields set to arbitrary values."""
    version = 2 if fields.pop("nifti2", False) else 1
    return lambda folder: write_raw(folder / name, None, fields, version=version)


def values(data: Callable[[], np.ndarray], name: str = "bad.nii.gz", affine: np.ndarray | None = None) -> Maker:
    """A well-formed file of these values."""
    return lambda folder: write(folder / name, data(), affine)


def content(name: str, data: Callable[[], bytes] | bytes) -> Maker:
    """A file with the given bytes."""

    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(data if isinstance(data, bytes) else data())
        return path

    return make


def packed(share: float = 1.0, flip: int | None = None) -> bytes:
    """A good compressed file, a truncated one, or one with an inverted byte."""
    whole = bytearray(gzip.compress(raw(), 1))
    if flip is not None:
        whole[flip] ^= 0xFF
    return bytes(whole[: int(share * len(whole))])


def link(target: str) -> Maker:
    def make(folder: Path) -> Path:
        (folder / "bad.nii.gz").symlink_to(target)
        return folder / "bad.nii.gz"

    return make


def folder_named(folder: Path) -> Path:
    (folder / "bad.nii.gz").mkdir()
    return folder / "bad.nii.gz"


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "bad.nii.gz")
    return folder / "bad.nii.gz"


def pair(cut: bool) -> Maker:
    """A header whose voxels lie in another file, which is truncated or missing."""

    def make(folder: Path) -> Path:
        nib.save(nib.Nifti1Pair(image(), AFFINE), folder / "bad.hdr")
        voxels = folder / "bad.img"
        if cut:
            voxels.write_bytes(voxels.read_bytes()[:-1])
        else:
            voxels.unlink()
        return folder / "bad.hdr"

    return make


def with_values(value: float, dtype: type = np.float32) -> Callable[[], np.ndarray]:
    """The good image with a given value in its centre."""

    def make() -> np.ndarray:
        data: np.ndarray = image().astype(dtype)
        data[12, 10, 4] = value
        return data

    return make


def bent(**entries: float) -> np.ndarray:
    """The good affine with entries such as a01=3 (row 0, column 1) changed."""
    affine = AFFINE.copy()
    for name, value in entries.items():
        affine[int(name[1]), int(name[2])] = value
    return affine


def only_sform(affine: np.ndarray) -> dict[str, Any]:
    rows = dict(zip(("srow_x", "srow_y", "srow_z"), affine[:3], strict=True))
    return {**rows, "sform_code": 1, "qform_code": 0}


NOT_READABLE, CUT_OFF = "not a readable NIfTI file", "voxels cannot be read.*cut off"
GREY = [3, 24, 20, 8, 1, 1, 1, 1]

BAD_STACKS: dict[str, tuple[Maker, str]] = {
    # not a file
    "missing": (lambda folder: folder / "bad.nii.gz", "no such file; check the path"),
    "missing folder": (lambda folder: folder / "no" / "bad.nii.gz", "no such file; check the path"),
    "below a file": (lambda folder: write(folder / "file.nii") / "bad.nii.gz", "cannot be read.*check"),
    "folder": (folder_named, "is a folder; expected a NIfTI file"),
    "DICOM folder": (lambda folder: folder, "is a folder; .*dcm2niix"),
    "link to nothing": (link("nowhere.nii.gz"), "no such file"),
    "link to itself": (link("bad.nii.gz"), "cannot be read"),
    "pipe": (pipe, "pipe or device"),
    "device": (link("/dev/zero"), "pipe or device"),
    "name too long": (lambda folder: folder / ("bad" * 100 + ".nii"), "cannot be read"),
    "zero byte in the name": (lambda folder: folder / "bad\0.nii", "cannot be read"),
    # not NIfTI
    "empty": (content("bad.nii.gz", b""), "it is empty"),
    "empty, plain": (content("bad.nii", b""), "it is empty"),
    "one byte": (content("bad.nii", b"x"), NOT_READABLE),
    "text": (content("bad.nii.gz", b"patient,age\n1,30\n"), "not compressed with gzip"),
    "text, plain": (content("bad.nii", b"patient,age\n" * 100), NOT_READABLE),
    "zeros": (content("bad.nii", bytes(5000)), NOT_READABLE),
    "random bytes": (content("bad.nii", lambda: np.random.default_rng(0).bytes(5000)), NOT_READABLE),
    "random bytes, packed": (
        content("bad.nii.gz", lambda: gzip.compress(np.random.default_rng(0).bytes(5000))),
        NOT_READABLE,
    ),
    "packed text": (content("bad.nii.gz", lambda: gzip.compress(b"not an image\n")), NOT_READABLE),
    "DICOM": (
        content("bad.dcm", bytes(128) + b"DICM" + bytes(500)),
        "not NIfTI by its name.*dcm2niix|is a DICOM image; .*g3r-infer --dicom",
    ),
    "MGH": (content("bad.mgz", lambda: gzip.compress(bytes(284))), "not NIfTI by its name"),
    "no ending": (content("bad", raw()), "not NIfTI by its name"),
    "bzip2": (content("bad.nii.bz2", lambda: bz2.compress(raw())), "not NIfTI by its name"),
    "packed, named .nii": (content("bad.nii", packed), "not named .gz.; rename it to bad.nii.gz"),
    "plain, named .nii.gz": (content("bad.nii.gz", raw), "not compressed with gzip"),
    "header without voxel file": (pair(cut=False), "voxels cannot be read"),
    "voxel file cut off": (pair(cut=True), CUT_OFF),
    # truncated and damaged
    "cut in the header": (content("bad.nii.gz", lambda: packed(0.004)), NOT_READABLE),
    "cut in the header, plain": (content("bad.nii", lambda: raw()[:200]), NOT_READABLE),
    "cut after the header": (content("bad.nii", lambda: raw()[:352]), CUT_OFF),
    "cut in the middle": (content("bad.nii.gz", lambda: packed(0.5)), CUT_OFF),
    "cut by a byte": (content("bad.nii.gz", lambda: packed()[:-1]), CUT_OFF),
    "cut by a byte, plain": (content("bad.nii", lambda: raw()[:-1]), CUT_OFF),
    "packed again after a cut": (content("bad.nii.gz", lambda: gzip.compress(raw()[:-500])), CUT_OFF),
    "a byte turned over": (content("bad.nii.gz", lambda: packed(flip=len(packed()) // 2)), CUT_OFF),
    "wrong checksum": (content("bad.nii.gz", lambda: packed(flip=-6)), CUT_OFF),
    "other bytes behind it": (content("bad.nii.gz", lambda: packed() + b"more" * 9), CUT_OFF),
    "70 MB of zeros behind it": (
        content("bad.nii.gz", lambda: gzip.compress(raw() + bytes(7 * 10**7), 1)),
        "far more than its header claims",
    ),
    # headers
    "wrong magic": (header(magic=b"nope"), NOT_READABLE),
    "wrong magic, plain": (header("bad.nii", magic=b"n+9\0"), NOT_READABLE),
    "no dimension": (header(dim=[0, *GREY[1:]]), "expected 3D|not a readable"),
    "eight dimensions": (header(dim=[8, *GREY[1:]]), NOT_READABLE),
    "minus one dimensions": (header(dim=[-1, *GREY[1:]]), NOT_READABLE),
    "first axis empty": (header(dim=[3, 0, 20, 8, 1, 1, 1, 1]), "empty axis"),
    "second axis empty": (header("bad.nii", dim=[3, 24, 0, 8, 1, 1, 1, 1]), "empty axis"),
    "third axis empty": (header(dim=[3, 24, 20, 0, 1, 1, 1, 1]), "empty axis"),
    "negative axis": (header(dim=[3, -24, 20, 8, 1, 1, 1, 1]), "empty axis"),
    "two dimensions": (header(dim=[2, 24, 20, 1, 1, 1, 1, 1]), "expected 3D"),
    "many frames": (values(lambda: image(shape=(12, 10, 8, 30))), "expected 3D.*split the frames"),
    "vectors": (values(lambda: image(shape=(12, 10, 8, 1, 3))), "expected 3D"),
    "huge shape": (header("bad.nii", dim=[3, 30000, 30000, 30000, 1, 1, 1, 1]), "ordinary size"),
    "huge shape, packed": (header(dim=[3, 30000, 30000, 30000, 1, 1, 1, 1]), "ordinary size"),
    "8 GB in a small file": (header("bad.nii", dim=[3, 600, 600, 600, 1, 1, 1, 1]), CUT_OFF),
    "8 GB in a small packed file": (header(dim=[3, 600, 600, 600, 1, 1, 1, 1], datatype=64), CUT_OFF),
    "more bytes than there are": (header(nifti2=True, dim=[3, 2**40, 2**20, 8, 1, 1, 1, 1]), "ordinary size"),
    "axes that overflow": (header(nifti2=True, dim=[3, 2**62, 2**62, 2**62, 1, 1, 1, 1]), "ordinary size"),
    "negative axis, NIfTI-2": (header(nifti2=True, dim=[3, -(2**62), 2, 2, 1, 1, 1, 1]), "empty axis"),
    "CIFTI": (header("bad.nii", nifti2=True, intent_code=3006), f"{NOT_READABLE}|expected NIfTI"),
    "no type": (header(datatype=0), NOT_READABLE),
    "bits": (header(datatype=1), NOT_READABLE),
    "unknown type": (header(datatype=9999), NOT_READABLE),
    "RGB": (values(lambda: np.zeros(SHAPE, [("R", "u1"), ("G", "u1"), ("B", "u1")])), "colour or complex"),
    "RGBA": (header(datatype=2304, bitpix=32), "colour or complex"),
    "complex": (values(lambda: image().astype(np.complex64)), "colour or complex"),
    "complex 128": (header(datatype=1792, bitpix=128), "colour or complex"),
    "voxels at NaN": (header(vox_offset=np.nan), NOT_READABLE),
    "voxels at infinity": (header(vox_offset=np.inf), NOT_READABLE),
    "voxels at minus 1000": (header(vox_offset=-1000), f"{NOT_READABLE}|{CUT_OFF}"),
    "voxels inside the header": (header(vox_offset=64), NOT_READABLE),
    "voxels beyond the end": (header("bad.nii", vox_offset=1e6), CUT_OFF),
    "voxels far beyond the end": (header(vox_offset=3e38), CUT_OFF),
    "endless extension": (
        lambda folder: write_raw(
            folder / "bad.nii",
            None,
            {"vox_offset": 800},
            extensions=((6, b"x" * 100),),
            # not 2**31, because nibabel would allocate that much memory, although it touches none of it
            cut=lambda whole: whole[:352] + (2**28).to_bytes(4, "little") + whole[356:],
        ),
        NOT_READABLE,
    ),
    "negative extension": (
        lambda folder: write_raw(
            folder / "bad.nii.gz",
            None,
            {"vox_offset": 800},
            extensions=((6, b"x" * 100),),
            cut=lambda whole: whole[:352] + (-16).to_bytes(4, "little", signed=True) + whole[356:],
        ),
        NOT_READABLE,
    ),
    # geometry
    "NaN affine": (header(**only_sform(bent(a11=np.nan))), "bad header.*fix the sform or qform"),
    "infinite affine": (header(**only_sform(bent(a03=np.inf))), "bad header"),
    "NaN origin": (header(**only_sform(bent(a23=np.nan))), "bad header"),
    "singular affine": (header(**only_sform(bent(a01=1, a11=0, a10=0))), "bad header.*singular"),
    "zero affine": (header(**only_sform(np.zeros((4, 4)))), "bad header.*singular"),
    "flat voxels": (header(**only_sform(bent(a22=0))), "bad header.*singular"),
    "huge affine": (header(**only_sform(AFFINE * 1e38)), "bad header|voxels of"),
    "sheared axes": (header(**only_sform(bent(a01=0.3))), "sheared.*resample"),
    "NaN quaternion": (header(sform_code=0, qform_code=1, quatern_b=np.nan), f"{NOT_READABLE}|bad header"),
    "long quaternion": (header(sform_code=0, qform_code=1, quatern_b=2.0, quatern_c=2.0), f"{NOT_READABLE}|bad header"),
    "pixdim 0": (header(sform_code=0, qform_code=1, pixdim=[1, 0, 1, 3, 0, 0, 0, 0]), "pixdim is 0"),
    "pixdim 0, no codes": (header(sform_code=0, qform_code=0, pixdim=[1, 1, 1, 0, *[0] * 4]), "pixdim is 0"),
    "pixdim NaN": (header(sform_code=0, pixdim=[1, np.nan, 1, 3, 0, 0, 0, 0]), "bad header"),
    "units of metres": (header(xyzt_units=1), "lengths in metres; expected mm"),
    "units of micrometres": (header(xyzt_units=3), "lengths in micrometres; expected mm"),
    "metres without a word": (header(**only_sform(AFFINE * 1e-3)), "voxels of 0.001 x 0.001 x 0.003 mm"),
    "micrometres without a word": (header(**only_sform(AFFINE * 1e3)), "voxels of .*units"),
    # intensities
    "slope beyond float32": (header(scl_slope=3e38), "not finite"),
    "intercept of NaN": (header(scl_slope=1, scl_inter=np.nan), f"{NOT_READABLE}|not finite|no positive"),
    "all NaN": (values(lambda: np.full(SHAPE, np.nan, np.float32)), "no positive value"),
    "all infinite": (values(lambda: np.full(SHAPE, np.inf, np.float32)), "not finite"),
    "one infinite": (values(with_values(np.inf)), "1 values inside the mask are not finite"),
    "beyond float32": (values(with_values(1e300, np.float64)), "1 values inside the mask are not finite"),
    "all zero": (values(lambda: np.zeros(SHAPE, np.int16)), "no positive value"),
    "all negative": (values(lambda: -image()), "no positive value"),
    "constant": (values(lambda: np.full(SHAPE, 7.0, np.float32)), "every value inside the mask is 7"),
    "too faint to divide by": (values(lambda: image() * np.float32(1e-36)), "largest value.*scale the image"),
    "too bright to square": (values(lambda: image() * np.float32(1e33)), "largest value.*scale the image"),
    "one slice": (values(lambda: image(shape=(24, 20, 1))), "holds 1 slice; expected a stack"),
    "one pixel": (values(lambda: image(shape=(1, 1, 8))), "12 masked pixels"),
    "a mask": (values(lambda: ball()), "every value inside the mask is 1; expected an image"),
}

LITTLE = "stack.nii.gz: no slice with 12 masked pixels; check the masks"


def moved(*translation_mm: float) -> np.ndarray:
    affine = AFFINE.copy()
    affine[:3, 3] += translation_mm
    return affine


def mask_with(**boxes: tuple[slice, ...]) -> np.ndarray:
    data = np.zeros(SHAPE, np.uint8)
    for box in boxes.values():
        data[box] = 1
    return data


BAD_MASKS: dict[str, tuple[Maker, str]] = {
    "missing": (lambda folder: folder / "bad.nii.gz", "no such file"),
    "folder": (folder_named, "is a folder"),
    "text": (content("bad.nii", b"mask\n" * 200), NOT_READABLE),
    "cut off": (content("bad.nii.gz", lambda: packed(0.5)), CUT_OFF),
    "all off": (values(lambda: np.zeros(SHAPE, np.uint8)), "mask is empty"),
    "all NaN": (values(lambda: np.full(SHAPE, np.nan, np.float32)), "mask is empty"),
    "all negative": (values(lambda: -ball().astype(np.int16)), "mask is empty"),
    "too faint": (values(lambda: ball() * np.float32(0.3)), "mask is empty"),
    "one voxel": (values(lambda: mask_with(a=(slice(9, 10), slice(9, 10), slice(3, 4)))), LITTLE),
    "a thread through all slices": (values(lambda: mask_with(a=(slice(9, 12), slice(9, 12)))), LITTLE),
    "fewer slices": (values(lambda: ball()[:, :, :-1]), "mask grid .* differs.*resample the mask"),
    "axes in another order": (values(lambda: ball().transpose(1, 0, 2)), "mask grid .* differs"),
    "many frames": (values(lambda: np.stack([ball()] * 3, -1)), "expected 3D"),
    "RGB": (values(lambda: np.zeros(SHAPE, [("R", "u1"), ("G", "u1"), ("B", "u1")])), "colour or complex"),
    "off by a voxel": (values(ball, affine=moved(1, 0, 0)), "off stack.nii.gz by its header"),
    "off by 10 m": (values(ball, affine=moved(0, 1e4, 0)), "off stack.nii.gz by its header"),
    "flipped": (values(ball, affine=AFFINE @ np.diag([-1.0, 1, 1, 1])), "off stack.nii.gz by its header"),
    "of larger voxels": (values(ball, affine=AFFINE @ np.diag([1.2, 1.2, 1, 1])), "off stack.nii.gz"),
    "NaN affine": (header(**only_sform(bent(a11=np.nan))), "bad header"),
    "the stack itself": (values(image), "as an image does; .*pass the mask"),
    "the stack as int16": (values(lambda: image().astype(np.int16)), "as an image does"),
}
"""Masks for `stack.nii.gz`, the good stack."""

_UNITS = {"sheared axes", "metres without a word", "micrometres without a word"}
_VALUES = {"one infinite", "beyond float32", "constant", "too faint to divide by", "too bright to square", "a mask"}
_SHAPES = {"one slice", "one pixel", "slope beyond float32"}
USABLE_AS_A_VOLUME = _UNITS | _VALUES | _SHAPES | {f"all {what}" for what in ("infinite", "zero", "negative", "NaN")}
"""Bad as a stack of thick slices; each command decides whether it accepts them as a volume."""
