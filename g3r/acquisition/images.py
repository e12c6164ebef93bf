"""Reading and writing NIfTI volumes, with every check a file from a scanner calls for."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from pathlib import Path

import nibabel as nib
import numpy as np
from nibabel.filebasedimages import ImageFileError
from numpy.typing import NDArray

from g3r.errors import InputError, cannot_be_written
from g3r.geometry import VolumeGrid

LARGEST_VOXEL_COUNT = 2**30
"""A header that claims more voxels than this is refused before any memory is taken."""

MASK_SHIFT_TOLERANCE_VOXELS = 0.5
"""Masks are drawn on copies whose headers lost digits: corners may differ by this much."""


@dataclass(frozen=True)
class Volume:
    """A 3D image: data float32 [I, J, K], affine [4, 4] (RAS+ mm from index), and its file's name."""

    data: NDArray[np.float32]
    affine: NDArray[np.float64]
    name: str = "volume"

    @property
    def grid(self) -> VolumeGrid:
        """The voxel grid."""
        return VolumeGrid(self.data.shape, self.affine)


def load_volume(path: str | os.PathLike[str]) -> Volume:
    """Read a 3D NIfTI image (or a 4D one with a single frame), scaled as its header says.

    Values that are not finite are kept; who uses them decides. The axes are not reordered.

    Raises:
        InputError: missing or unreadable file, not a NIfTI, more than one frame, complex or colour data,
            an empty axis, an affine that is not finite or not invertible.
    """
    path = Path(path)
    name = path.name
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a NIfTI file (.nii or .nii.gz)")
    try:
        image = nib.load(path)
    except (ImageFileError, OSError, EOFError, zlib.error, ValueError) as error:
        raise InputError(
            f"{name}: not a readable NIfTI file ({_one_line(error)}); expected .nii or .nii.gz"
        ) from None
    if not isinstance(image, (nib.Nifti1Image, nib.Nifti2Image, nib.Nifti1Pair)):
        raise InputError(f"{name}: is a {type(image).__name__}; expected NIfTI, convert it first")
    shape = tuple(int(n) for n in image.shape)
    if len(shape) > 3 and all(n == 1 for n in shape[3:]):
        shape = shape[:3]
    if len(shape) != 3:
        raise InputError(
            f"{name}: has shape {image.shape}; expected 3D, or 4D with one frame: split the frames"
        )
    if min(shape) < 1:
        raise InputError(f"{name}: has an empty axis (shape {shape}); export the image again")
    if int(np.prod(shape, dtype=np.float64)) > LARGEST_VOXEL_COUNT:
        raise InputError(f"{name}: header claims {shape} voxels; expected a stack or volume of ordinary size")
    dtype = image.get_data_dtype()
    if dtype.names is not None or np.issubdtype(dtype, np.complexfloating):
        raise InputError(
            f"{name}: holds {dtype} values (colour or complex); expected one real number a voxel"
        )
    affine = np.array(image.affine, dtype=np.float64)
    try:
        VolumeGrid(shape, affine)
    except ValueError as error:
        raise InputError(f"{name}: bad header ({error}); fix the sform or qform") from None
    try:
        data = np.asarray(image.dataobj, dtype=np.float32).reshape(shape)
    except (OSError, EOFError, zlib.error, ValueError, ImageFileError) as error:
        raise InputError(
            f"{name}: voxels cannot be read ({_one_line(error)}); the file may be cut off"
        ) from None
    return Volume(data, affine, name)


def load_mask(path: str | os.PathLike[str], reference: Volume) -> NDArray[np.bool_]:
    """Read a mask [I, J, K] on the grid of an image; above one half is inside.

    Raises:
        InputError: as `load_volume`, or a mask on another grid (other shape, or corners more than half a
            voxel away), or an empty one.
    """
    mask = load_volume(path)
    if mask.data.shape != reference.data.shape:
        raise InputError(
            f"{mask.name}: mask grid {mask.data.shape} differs from that of {reference.name} "
            f"{reference.data.shape}; resample the mask or pass the matching file"
        )
    corners = (
        np.array(np.meshgrid(*[(0, n - 1) for n in reference.data.shape], indexing="ij")).reshape(3, -1).T
    )
    offset = reference.grid.index(mask.grid.world(corners)) - corners
    if np.abs(offset).max() > MASK_SHIFT_TOLERANCE_VOXELS:
        raise InputError(
            f"{mask.name}: mask lies up to {np.abs(offset).max():.2g} voxels off {reference.name} by its "
            "header; resample the mask or pass the matching file"
        )
    inside = np.nan_to_num(mask.data) > 0.5
    if not inside.any():
        raise InputError(f"{mask.name}: mask is empty; expected the brain to be marked with 1")
    return inside


def save_volume(path: str | os.PathLike[str], data: NDArray[np.generic], affine: NDArray[np.float64]) -> None:
    """Write a volume as NIfTI: float32, or uint8 for masks, int16 as it is. Whole or not at all.

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
    image.set_sform(affine, code="scanner")
    image.set_qform(affine, code="scanner")
    suffix = ".nii.gz" if path.name.endswith(".nii.gz") else ".nii"
    beside = path.with_name(f".{path.name}.{os.getpid()}{suffix}")
    try:
        nib.save(image, beside)
        os.replace(beside, path)
    except OSError as error:
        raise cannot_be_written(path, error, array.nbytes) from None
    finally:
        beside.unlink(missing_ok=True)


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text[:120] if text else type(error).__name__
