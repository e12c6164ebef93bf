"""An examination of three oblique stacks with gaps, as DICOM and as NIfTI, with series that are not stacks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.geometry.rigid import rotation_matrix

THICKNESS_MM = 3.2
"""The stacks' slices are 4 mm apart."""

STACKS = (3, 4, 7)
"""Numbers of the series that are stacks; the first two have the same description."""

LOCALISER, DERIVED, VOLUMETRIC, SHORT, FLAWED, DIFFUSION = 1, 5, 6, 8, 9, 10

MISSING = 6
"""Slice of the series `FLAWED`, from 0."""


@dataclass(frozen=True)
class Examination:
    """Folders of the examination: DICOM; stacks with sidecars and masks as NIfTI; masks on the grids of dcm2niix."""

    dicom: Path
    stacks: list[Path]
    masks: list[Path]
    dicom_masks: list[Path]


@pytest.fixture(scope="session")
def examination(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Examination:
    """The examination, written once; tests must not write to it."""
    from tests.dicom.dicom_files import Study

    folder = tmp_path_factory.mktemp("examination")
    (folder / "dicom").mkdir()
    study = Study(folder / "dicom")
    found = Examination(folder / "dicom", [], [], [])
    tilted = tilt()
    for n, number in enumerate(STACKS):
        image = nib.Nifti1Image.from_filename(subject / f"stack-{n}.nii.gz")
        mask = nib.Nifti1Image.from_filename(subject / f"mask-{n}.nii.gz")
        data, affine = np.asarray(image.dataobj), tilted @ image.affine
        assert data.min() >= 0
        study.write(data, affine, number, thickness_mm=THICKNESS_MM)
        stack = folder / f"stack-{n}.nii.gz"
        nib.save(nib.Nifti1Image(data, affine), stack)
        stack.with_name(f"stack-{n}.json").write_text(json.dumps({"SliceThickness": THICKNESS_MM}))
        found.stacks.append(stack)
        for masks, name, flipped in ((found.masks, "mask", False), (found.dicom_masks, "dicom-mask", True)):
            path = folder / f"{name}-{n}.nii.gz"
            inside = np.asarray(mask.dataobj)
            nib.save(nib.Nifti1Image(*(second_axis_flipped(inside, affine) if flipped else (inside, affine))), path)
            masks.append(path)
    _write_others(study)
    (folder / "dicom" / "notes.txt").write_text("not DICOM")
    (folder / "dicom" / "DICOMDIR").write_bytes(b"\0" * 128 + b"DICM" + b"damaged")
    return found


def tilt() -> NDArray[np.float64]:
    """A rigid motion of the world [4, 4] that makes every stack oblique in all three angles."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(np.array([0.21, -0.13, 0.35]))
    matrix[:3, 3] = 5.0, -7.0, 11.0
    return matrix


def second_axis_flipped(data: NDArray[Any], affine: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """The same image as stored by dcm2niix, with reversed rows."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    flip[1, 3] = data.shape[1] - 1
    return np.ascontiguousarray(data[:, ::-1]), affine @ flip


def block(n_slices: int = 12) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """A small image without content, and its affine."""
    rng = np.random.default_rng(n_slices)
    return rng.integers(1, 900, (10, 12, n_slices)).astype(np.int16), np.diag([1.5, 1.5, 4.0, 1.0])


def _write_others(study: Any) -> None:
    """Write series that must not be chosen."""
    data, affine = block()
    turned = affine[:, [1, 2, 0, 3]]
    study.write(data, affine, LOCALISER, SeriesDescription="t2_haste_loc", thickness_mm=7)
    study.write(data, turned, DERIVED, ImageType=["DERIVED", "SECONDARY", "MPR"])
    study.write(data, affine, VOLUMETRIC, MRAcquisitionType="3D")
    study.write(*block(7), SHORT)
    study.write(data, affine, FLAWED, missing=[MISSING])
    study.write(data, affine, DIFFUSION, ScanningSequence="EP")
