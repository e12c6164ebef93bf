"""Reader of slices whose headers hold their poses: `N.nii.gz`, `mask_N.nii.gz` and the lines of `index.tsv`."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume, load_volume, read_mask
from g3r.acquisition.nifti import NO_ORIENTATION
from g3r.acquisition.stack_checks import ORTHOGONALITY_TOLERANCE, SPACING_RANGE_MM, spaced
from g3r.errors import InputError
from g3r.geometry import VolumeGrid
from g3r.geometry.rigid import orthonormal

INDEX_NAME = "index.tsv"
INDEX_COLUMNS = ["number", "stack", "slice"]

MAX_SLICE_NUMBER = 2000
"""Larger slice numbers are errors, and would take memory for the slices in between."""

FILE_NAME = re.compile(r"(mask_)?(\d+)\.nii(?:\.gz)?", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class SliceFile:
    """A slice as read from its file.

    Attributes:
        number: N of its file name.
        path: path of the image.
        mask_path: path of the mask; None if the pixels above zero are the mask.
        image: [I, J] float32.
        mask: [I, J] bool; may be empty.
        affine: [4, 4] RAS mm from index, as in the header.
        remarks: remarks on the header.
    """

    number: int
    path: Path
    mask_path: Path | None
    image: NDArray[np.float32]
    mask: NDArray[np.bool_]
    affine: NDArray[np.float64]
    remarks: tuple[str, ...] = ()

    @cached_property
    def spacing_mm(self) -> NDArray[np.float64]:
        """Pixel spacing (two numbers) and thickness [3]."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0), np.float64)

    @cached_property
    def rotation(self) -> NDArray[np.float64]:
        """Columns are in-plane x, in-plane y, normal [3, 3]; right-handed, whatever the third axis of the file."""
        return orthonormal(VolumeGrid((*self.image.shape, 1), self.affine).plane_frame[None])[0]

    @cached_property
    def center_mm(self) -> NDArray[np.float64]:
        """The middle of the pixel grid [3]."""
        middle = [(n - 1) / 2 for n in self.image.shape]
        return np.asarray(self.affine[:3, :2] @ middle + self.affine[:3, 3], np.float64)


def slice_folder_of(path: str | os.PathLike[str]) -> Path:
    """The folder itself if it holds N.nii.gz, or else its folder `slices/`.

    Raises:
        InputError: it is not a folder, or neither holds slices.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; expected one of slices (N.nii.gz), pass stacks with --stacks")
    for one in (folder, folder / "slices"):
        if one.is_dir() and any(numbered_files(one)[0]):
            return one
    raise InputError(
        f"{folder}: holds no slice; expected 0.nii.gz, 1.nii.gz, ... in it or in its folder slices, as NeSVoR and "
        "g3r-export-poses --format nesvor --stacks write them"
    )


def numbered_files(folder: Path) -> tuple[dict[int, Path], dict[int, Path]]:
    """Files of slices and of masks by their numbers, in ascending order; other files are ignored.

    Raises:
        InputError: two files have one number, or the folder cannot be read.
    """
    found: tuple[dict[int, Path], dict[int, Path]] = {}, {}
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from None
    for path in paths:
        match = FILE_NAME.fullmatch(path.name)
        if match is None:
            continue
        kind = found[1 if match[1] else 0]
        number = int(match[2])
        if number in kind:
            raise InputError(
                f"{path.name}: has the number of {kind[number].name}; expected one file for each number, remove one"
            )
        kind[number] = path
    return dict(sorted(found[0].items())), dict(sorted(found[1].items()))


def read_slices(folder: Path) -> list[SliceFile]:
    """All slices of a folder in the order of their numbers.

    Raises:
        InputError: a file cannot be used.
    """
    images, masks = numbered_files(folder)
    return [read_slice(path, masks.get(number), number) for number, path in images.items()]


def read_slice(path: Path, mask_path: Path | None, number: int) -> SliceFile:
    """Read one slice and its mask.

    Args:
        path: path of the image.
        mask_path: None takes the pixels above zero.
        number: number of the slice.

    Raises:
        InputError: the file is unreadable, holds more than one slice or has no slice's axes, values in the mask are
            not finite, or the mask is on another grid.
    """
    volume = load_volume(path)
    _check_geometry(volume)
    mask = np.nan_to_num(volume.data) > 0 if mask_path is None else read_mask(mask_path, volume)
    n_bad = int((~np.isfinite(volume.data[mask])).sum())
    if n_bad:
        raise InputError(f"{path.name}: {n_bad} values inside the mask are not finite; repair or mask them out")
    image = np.where(np.isfinite(volume.data), volume.data, np.float32(0))
    return SliceFile(
        number=number,
        path=path,
        mask_path=mask_path,
        image=image[:, :, 0],
        mask=mask[:, :, 0],
        affine=volume.affine,
        remarks=volume.remarks,
    )


def _check_geometry(volume: Volume) -> None:
    """Raise `InputError` unless a volume is a slice with a pose."""
    name, shape = volume.name, volume.data.shape
    if shape[2] != 1:
        raise InputError(
            f"{name}: has shape {shape}; expected a single slice (I, J, 1), pass stacks of slices with --stacks"
        )
    if NO_ORIENTATION in volume.remarks:
        raise InputError(f"{name}: {NO_ORIENTATION}; expected the slice's pose, write its sform")
    spacing = volume.grid.spacing_mm
    low, high = SPACING_RANGE_MM
    if not (low <= spacing.min() and spacing.max() <= high):
        raise InputError(
            f"{name}: pixels and thickness of {spaced(spacing)} mm; expected {low:g} to {high:g} mm, check the header"
        )
    if volume.grid.shear > ORTHOGONALITY_TOLERANCE:
        raise InputError(
            f"{name}: axes are sheared (cosine {volume.grid.shear:.2g}); expected a rigid pose, write an affine with "
            "orthogonal axes"
        )


def read_index(folder: Path) -> tuple[Path, dict[int, tuple[int, int]]] | None:
    """Path of `index.tsv` in the folder or the one above, and its stack and slice by number; None without one.

    A file of that name with other columns belongs to another program.

    Raises:
        InputError: a line is not three whole numbers from 0 on, or a number or a slice occurs twice.
    """
    for path in (folder / INDEX_NAME, folder.resolve().parent / INDEX_NAME):
        if not path.is_file():
            continue
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError):
            raise InputError(f"{path}: cannot be read as text; repair it, or remove it to group by headers") from None
        if lines and lines[0].split("\t") == INDEX_COLUMNS:
            return path, _rows(path, lines[1:])
    return None


def _rows(path: Path, lines: list[str]) -> dict[int, tuple[int, int]]:
    found: dict[int, tuple[int, int]] = {}
    for line in filter(str.strip, lines):
        words = line.split("\t")
        try:
            number, stack, index = (int(word) for word in words)
        except ValueError:
            number = stack = index = -1
        if min(number, stack, index) < 0:
            raise InputError(f"{path.name}: line {line!r}; expected number, stack and slice from 0 on, with tabs")
        if index > MAX_SLICE_NUMBER:
            raise InputError(f"{path.name}: slice {index} of stack {stack}; expected at most {MAX_SLICE_NUMBER}")
        if number in found or (stack, index) in found.values():
            what = f"number {number}" if number in found else f"slice {index} of stack {stack}"
            raise InputError(f"{path.name}: has {what} twice; expected each once, remove one line")
        found[number] = (stack, index)
    return found
