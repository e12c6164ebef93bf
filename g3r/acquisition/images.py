"""Reading and writing of NIfTI volumes and masks, checked."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import nibabel as nib
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.header_text import HeaderText
from g3r.acquisition.nifti import checked_grid, open_nifti, orientation_remarks, voxels
from g3r.errors import InputError, cannot_be_written
from g3r.geometry import VolumeGrid
from g3r.run.atomic_file import atomic_path

Space = Literal["scanner", "standard"]

FORM_CODES: dict[Space, str] = {"scanner": "scanner", "standard": "aligned"}
"""NIfTI code of the space that an affine leads to; "aligned" means aligned to anything but the scanner."""

MASK_SHIFT_TOLERANCE_VOXELS = 0.5
"""Masks are drawn on copies whose headers lost digits: corners may differ by this much."""

MAX_LABELS = 256
"""A mask with more distinct values above 1 than this is an image."""

SCALED_TO, FEWEST_STEPS, NEAR_TOP = (100.0, 255.0), 40, 0.9
"""Maxima of probabilities that were scaled to whole numbers, fewest values above 1 of such a mask, and share of the
maximum that most of its brain reaches."""


@dataclass(frozen=True)
class Volume:
    """A 3D image: data float32 [I, J, K], affine [4, 4] (RAS+ mm from index), and its file's name.

    `remarks` are lines about its header that matter to users who rely on its orientation.
    """

    data: NDArray[np.float32]
    affine: NDArray[np.float64]
    name: str = "volume"
    remarks: tuple[str, ...] = ()

    @property
    def grid(self) -> VolumeGrid:
        """The voxel grid."""
        return VolumeGrid(self.data.shape, self.affine)


def load_volume(path: str | os.PathLike[str]) -> Volume:
    """Read a 3D NIfTI image (or a 4D one with a single frame), scaled as its header says.

    Values that are not finite are kept. The axes are not reordered.

    Raises:
        InputError: missing or unreadable file, not a NIfTI, more than one frame, complex or colour data,
            an empty axis, more voxels than the file holds, lengths that are not in mm, an affine that is not
            finite or not invertible.
    """
    name = Path(path).name
    image, repairs = open_nifti(path)
    grid = checked_grid(image, name)
    data = voxels(image, grid.shape, name)
    return Volume(data, grid.affine, name, (*repairs, *orientation_remarks(image, grid)))


def names_of(paths: Sequence[str | os.PathLike[str]]) -> list[str]:
    """File names by which people can tell stacks apart: without folders, which may name patients.

    A name that occurs several times is followed by the number of the stack, from 1 in the order given.

    Args:
        paths: of all stacks of a run.
    """
    names = [Path(path).name for path in paths]
    return [f"{name} (stack {n + 1})" if names.count(name) > 1 else name for n, name in enumerate(names)]


def load_mask(path: str | os.PathLike[str], reference: Volume) -> NDArray[np.bool_]:
    """Read a mask [I, J, K] on the grid of an image; values above one half (probabilities, labels) are inside.

    Raises:
        InputError: as `load_volume`, or a mask on another grid (other shape, or corners more than half a
            voxel away), or an empty one, or an image.
    """
    inside = read_mask(path, reference)
    if not inside.any():
        raise InputError(f"{Path(path).name}: mask is empty; expected the brain to be marked with 1")
    return inside


def read_mask(path: str | os.PathLike[str], reference: Volume) -> NDArray[np.bool_]:
    """As `load_mask`, but the mask may be empty: not every slice shows the brain.

    Raises:
        InputError: as `load_mask`.
    """
    mask = load_volume(path)
    check_grid(mask, reference.grid, f"that of {reference.name}", "mask")
    _check_mask_values(mask)
    return np.nan_to_num(mask.data) > _threshold(mask.data)


def check_grid(found: Volume, expected: VolumeGrid, of: str, kind: str) -> None:
    """Raise `InputError` for an image on another grid: other shape, or corners more than half a voxel away.

    Args:
        found: the image that was read.
        expected: the grid that it should have.
        of: whose grid that is, in words: "that of stack.nii.gz".
        kind: of image, in one word.
    """
    if found.data.shape != expected.shape:
        raise InputError(
            f"{found.name}: {kind} grid {found.data.shape} differs from {of} {expected.shape}; "
            f"resample the {kind} or pass the matching file"
        )
    corners = expected.corner_index
    offset = expected.index(found.grid.world(corners)) - corners
    if np.abs(offset).max() > MASK_SHIFT_TOLERANCE_VOXELS:
        name = of.removeprefix("that of ")
        raise InputError(
            f"{found.name}: {kind} is up to {np.abs(offset).max():.2g} voxels off {name} by its "
            f"header; resample the {kind} or pass the matching file"
        )


def _check_mask_values(mask: Volume) -> None:
    """Raise `InputError` for an image given as mask: neither 0 and one value, nor a probability, nor labels."""
    above = mask.data[mask.data > 1]
    if not above.size or above.max() < 2 or (above == above[0]).all():  # spline interpolation overshoots 1
        return
    whole = (above == np.rint(above)).all()
    if not whole or len(np.unique(above)) > MAX_LABELS:
        raise InputError(
            f"{mask.name}: holds values up to {above.max():g} as an image does; expected a mask of 0 and 1 "
            "(or labels, or a probability); pass the mask that belongs to the stack"
        )


def _threshold(mask: NDArray[np.floating]) -> float:
    """Value above which a mask's voxel is brain: half of 1, or of the 100 or 255 to which a probability was scaled.

    Labels may reach these numbers, too, but a probability is near its maximum in most of the brain.
    """
    top = float(np.nanmax(mask, initial=0))
    if top not in SCALED_TO or len(np.unique(mask[mask > 1])) < FEWEST_STEPS:
        return 0.5
    return 0.5 * top if np.mean(mask[mask > 0] > NEAR_TOP * top) > 0.5 else 0.5


def save_volume(
    path: str | os.PathLike[str],
    data: NDArray[np.generic],
    affine: NDArray[np.float64],
    header_text: HeaderText | None = None,
    space: Space = "scanner",
) -> None:
    """Write a volume as NIfTI, whole or not at all: float32, or uint8 for masks; uint8 and int16 stay.

    Args:
        path: of the file.
        data: [I, J, K].
        affine: [4, 4] RAS+ mm from index.
        header_text: free text for the header; none when None.
        space: the space that the affine leads to: the scanner's, or the standard orientation of a result.

    Raises:
        InputError: the folder cannot be written.
    """
    path = Path(path)
    array = np.asarray(data)
    if array.dtype == np.bool_:
        array = array.astype(np.uint8)
    elif array.dtype not in (np.dtype(np.uint8), np.dtype(np.int16)):
        array = array.astype(np.float32)
    image = nib.Nifti1Image(array, affine)
    image.header.set_xyzt_units("mm")
    image.set_sform(affine, code=FORM_CODES[space])
    image.set_qform(affine, code=FORM_CODES[space])
    if header_text is not None:
        header_text.put_into(image)
    try:
        with atomic_path(path) as temporary:
            nib.save(image, temporary)
    except OSError as error:
        raise cannot_be_written(path, error, array.nbytes) from None
