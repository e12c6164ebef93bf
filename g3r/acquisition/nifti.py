"""Opening NIfTI files of unknown origin: a header is checked before memory is allocated for what it claims."""

from __future__ import annotations

import gzip
import logging
import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import nibabel as nib
import numpy as np
from nibabel.arrayproxy import ArrayProxy
from numpy.typing import NDArray

from g3r.errors import InputError, one_line
from g3r.geometry import VolumeGrid

MAX_VOXEL_COUNT = 2**28
"""Headers that claim more voxels than this (1 GB as float32) are refused."""

MAX_VOXEL_BYTES = 8 * MAX_VOXEL_COUNT

GZIP_RATIO = 1032
"""Largest expansion of deflate (zlib's documentation), which bounds what a compressed file can hold."""

BLOCK_BYTES, MAX_BLOCKS_BEYOND = 2**20, 64
"""What follows the voxels of a compressed file is read in blocks of this size, up to this many."""

NIFTI_ENDINGS = (".nii", ".hdr", ".img")
"""File endings, alone or before .gz; .hdr and .img are the two files of a pair."""

LENGTH_UNITS = {1: "metres", 3: "micrometres"}
"""Codes of a header's xyzt_units that are not millimetres (2) and not unknown (0)."""

HEADERS_AGREE_VOXELS = 0.5
"""Largest distance (voxels) between the corners by sform and by qform that is not reported."""

NO_SIZE = "setting 0 dims to 1"
"""nibabel's message for a pixdim of zero, where only an sform gives the voxel size."""

NO_ORIENTATION = "header holds no orientation (sform_code and qform_code are 0); axes are taken as they are"
"""Remark on an image whose place in space is unknown."""

NiftiImage = nib.Nifti1Image | nib.Nifti2Image | nib.Nifti1Pair


def open_nifti(path: str | os.PathLike[str]) -> tuple[NiftiImage, list[str]]:
    """Read the header of a NIfTI image, but not its voxels.

    Returns:
        The image, and a line for each repair of its header.

    Raises:
        InputError: no such file, not a file, not NIfTI, or a header that cannot be read.
    """
    path = Path(path)
    _check_file(path)
    try:
        with _remarks() as remarks:
            # no memory map: a file that is cut or written while it is mapped would kill the process
            image = nib.load(path, mmap=False)
    except Exception as error:  # nibabel's parsers raise whatever damaged bytes make them raise
        found = one_line(error).replace(str(path), path.name)
        raise InputError(f"{path.name}: not a readable NIfTI file ({found}); expected .nii or .nii.gz") from None
    if isinstance(image, NiftiImage) and int(image.header["sform_code"]) <= 0 and NO_SIZE in " ".join(remarks):
        raise InputError(f"{path.name}: bad header (pixdim is 0); fix pixdim, or give it an sform")
    if not isinstance(image, NiftiImage):
        raise InputError(f"{path.name}: is a {type(image).__name__}; expected NIfTI, convert it first")
    return image, remarks


def checked_grid(image: NiftiImage, name: str) -> VolumeGrid:
    """The grid of an image with one frame of real numbers.

    Raises:
        InputError: more than one frame, colour or complex data, an empty axis, more voxels than the file or
            `MAX_VOXEL_COUNT` allows, lengths in other units, a bad affine.
    """
    shape = tuple(int(n) for n in image.shape)
    if len(shape) > 3 and all(n == 1 for n in shape[3:]):
        shape = shape[:3]
    if len(shape) != 3:
        raise InputError(f"{name}: has shape {image.shape}; expected 3D, or 4D with one frame: split the frames")
    if min(shape) < 1:
        raise InputError(f"{name}: has an empty axis (shape {shape}); export the image again")
    dtype = image.get_data_dtype()
    if dtype.kind not in "iuf":
        raise InputError(f"{name}: holds {dtype} values (colour or complex); expected one real number a voxel")
    _check_size(image, shape, dtype.itemsize, name)
    units = LENGTH_UNITS.get(int(image.header["xyzt_units"]) & 7)
    if units:
        raise InputError(
            f"{name}: header gives lengths in {units}; expected mm, convert the header (xyzt_units and affine)"
        )
    try:
        return VolumeGrid((shape[0], shape[1], shape[2]), np.array(image.affine, dtype=np.float64))
    except ValueError as error:
        raise InputError(f"{name}: bad header ({error}); fix the sform or qform") from None


def voxels(image: NiftiImage, shape: tuple[int, int, int], name: str) -> NDArray[np.float32]:
    """Values [I, J, K] as float32, scaled as the header says.

    Args:
        image: see `open_nifti`.
        shape: of its grid, see `checked_grid`.
        name: for messages.

    Raises:
        InputError: a file that is cut off or damaged.
    """
    try:
        with np.errstate(all="ignore"), _remarks():  # overflow becomes infinite, and the caller decides
            return _read(image).reshape(shape)
    except InputError:
        raise
    except Exception as error:  # zlib, gzip and nibabel have many names for damage
        if isinstance(error, MemoryError):
            raise
        raise InputError(f"{name}: voxels cannot be read ({one_line(error)}); the file may be cut off") from None


def _read(image: NiftiImage) -> NDArray[np.float32]:
    """Scaled values; a compressed file is read to its end, where the checksum is."""
    file = Path(str(image.file_map["image"].filename))
    if not file.name.lower().endswith(".gz"):
        return np.asarray(image.dataobj, dtype=np.float32)
    of_file: Any = image.dataobj
    layout = (of_file.shape, of_file.dtype, of_file.offset, of_file.slope, of_file.inter)
    with gzip.open(file) as stream:
        data = np.asarray(ArrayProxy(stream, layout, mmap=False), dtype=np.float32)
        for _ in range(MAX_BLOCKS_BEYOND):
            if not stream.read(BLOCK_BYTES):
                return data
    raise InputError(f"{file.name}: holds far more than its header claims; export the image again")


def orientation_remarks(image: NiftiImage, grid: VolumeGrid) -> list[str]:
    """Lines about the orientation in a header that a user should know."""
    header = image.header
    sform, qform = int(header["sform_code"]), int(header["qform_code"])
    if sform <= 0 and qform <= 0:
        return [NO_ORIENTATION]
    if sform <= 0 or qform <= 0:
        return []
    try:
        with _remarks():
            other = VolumeGrid(grid.shape, header.get_qform())
    except Exception:  # the sform is the one that is used
        return ["the qform cannot be read; the sform is used"]
    corners = grid.corner_index
    apart_mm = float(np.linalg.norm(grid.world(corners) - other.world(corners), axis=1).max())
    if apart_mm <= HEADERS_AGREE_VOXELS * grid.spacing_mm.min():
        return []
    return [f"sform and qform differ by up to {apart_mm:.3g} mm; the sform is used"]


def _check_file(path: Path) -> None:
    """Raise `InputError` for anything but a file that could be NIfTI; reads two bytes at most."""
    try:
        status = path.stat()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except (OSError, ValueError) as error:  # a loop of links, a name too long, a zero byte in it
        found = getattr(error, "strerror", None) or one_line(error)
        raise InputError(f"{path}: cannot be read ({found}); check the path") from None
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path}: is a folder; expected a NIfTI file (.nii or .nii.gz; dcm2niix makes one of DICOM)")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is a pipe or device; expected a NIfTI file (.nii or .nii.gz)")
    name = path.name.lower()
    compressed = name.endswith(".gz")
    if not name.removesuffix(".gz").endswith(NIFTI_ENDINGS):
        raise InputError(
            f"{path.name}: is not NIfTI by its name; expected .nii or .nii.gz, convert it first (dcm2niix for DICOM)"
        )
    try:
        with path.open("rb") as stream:
            is_gzip = stream.read(2) == b"\x1f\x8b"
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if status.st_size == 0:
        raise InputError(f"{path.name}: not a readable NIfTI file (it is empty); copy or export it again")
    if compressed and not is_gzip:
        raise InputError(
            f"{path.name}: not a readable NIfTI file (named .gz, but not compressed with gzip); rename it if "
            "it is plain NIfTI, or copy it again"
        )
    if is_gzip and not compressed:
        raise InputError(
            f"{path.name}: not a readable NIfTI file (compressed with gzip, but not named .gz); rename it to "
            f"{path.name}.gz"
        )


def _check_size(image: NiftiImage, shape: tuple[int, ...], voxel_bytes: int, name: str) -> None:
    """Raise `InputError` for more voxels than allowed, or than the file can hold."""
    n_voxels = 1
    for extent in shape:  # in whole numbers, which do not overflow
        n_voxels *= extent
    claimed = n_voxels * voxel_bytes
    if n_voxels > MAX_VOXEL_COUNT or claimed > MAX_VOXEL_BYTES:
        raise InputError(
            f"{name}: header claims {shape} voxels ({claimed / 1e9:.3g} GB); expected a stack or volume of "
            "ordinary size"
        )
    file, of_file = Path(str(image.file_map["image"].filename)), cast(Any, image.dataobj)
    try:
        size = file.stat().st_size
        start = int(of_file.offset)
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: voxels cannot be read ({one_line(error)}); the file may be cut off") from None
    room = size * GZIP_RATIO if file.name.lower().endswith(".gz") else size
    if start < 0 or start + claimed > room:
        raise InputError(
            f"{name}: voxels cannot be read (header claims {claimed} bytes from {start} on, the file of "
            f"{size} cannot hold them); the file may be cut off"
        )


@contextmanager
def _remarks() -> Iterator[list[str]]:
    """Collect what nibabel and numpy would log or warn about a file, as lines."""
    lines: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(" ".join(record.getMessage().split()))

    logger: Any = nib.imageglobals.logger
    handlers, propagates = logger.handlers, logger.propagate
    logger.handlers, logger.propagate = [Collector()], False
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield lines
        lines += [" ".join(str(one.message).split()) for one in caught]
    finally:
        logger.handlers, logger.propagate = handlers, propagates
