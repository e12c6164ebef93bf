"""Headers of the DICOM images below a folder, reduced to the fields that the choice and use of series need."""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from g3r.dicom.files import dicom_files
from g3r.errors import InputError

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

FARTHEST_MM = 1e5
"""Largest coordinate of an image position that is accepted."""

TEXTS = {
    "sop_class_uid": "SOPClassUID",
    "sop_uid": "SOPInstanceUID",
    "series_uid": "SeriesInstanceUID",
    "study_uid": "StudyInstanceUID",
    "frame_uid": "FrameOfReferenceUID",
    "patient_id": "PatientID",
    "description": "SeriesDescription",
    "protocol": "ProtocolName",
    "modality": "Modality",
    "acquisition_type": "MRAcquisitionType",
    "acquired_on": "AcquisitionDate",
    "acquired_at": "AcquisitionTime",
}
"""Texts that are read, by our name; "" if absent from a header."""

NUMBERS = {
    "number": "SeriesNumber",
    "instance_number": "InstanceNumber",
    "echo_time_ms": "EchoTime",
    "thickness_mm": "SliceThickness",
    "rows": "Rows",
    "columns": "Columns",
    "bits": "BitsAllocated",
    "n_frames": "NumberOfFrames",
}
"""Numbers that are read; None if absent from a header."""

LISTS = {"image_type": "ImageType", "scanning_sequence": "ScanningSequence"}
"""Code words that are read; () if absent from a header."""

MR_CLASSES = "1.2.840.10008.5.1.4.1.1.4"
"""Prefix of the UIDs of MR image classes. Such a file has pixels; without them its header is cut off."""

POSITION, AXES = "ImagePositionPatient", "ImageOrientationPatient"

Value = TypeVar("Value")


@dataclass(frozen=True, kw_only=True)
class ImageHeader:
    """The header of one DICOM image.

    Attributes:
        path: path of its file.
        position_mm: position of the centre of its first pixel, in the patient's frame (LPS); None if absent.
        axes: [2, 3] directions of a row and of a column; None if absent.
        is_cut: whether the file is too short for its pixels.
        sop_class_uid, sop_uid, series_uid, study_uid, frame_uid, patient_id, description, protocol, modality,
            acquisition_type, acquired_on, acquired_at: see `TEXTS`.
        number, instance_number, echo_time_ms, thickness_mm, rows, columns, bits, n_frames: see `NUMBERS`.
        image_type, scanning_sequence: see `LISTS`.
    """

    path: Path
    position_mm: NDArray[np.float64] | None
    axes: NDArray[np.float64] | None
    is_cut: bool
    sop_class_uid: str
    sop_uid: str
    series_uid: str
    study_uid: str
    frame_uid: str
    patient_id: str
    description: str
    protocol: str
    modality: str
    acquisition_type: str
    acquired_on: str
    acquired_at: str
    number: float | None
    instance_number: float | None
    echo_time_ms: float | None
    thickness_mm: float | None
    rows: float | None
    columns: float | None
    bits: float | None
    n_frames: float | None
    image_type: tuple[str, ...]
    scanning_sequence: tuple[str, ...]


@dataclass(frozen=True)
class FoundImages:
    """The images found below a folder.

    Attributes:
        images: all images, each once.
        n_damaged: DICOM files that are left out, because their headers cannot be read.
        n_unreadable: files and folders without read permission, so that their kind is unknown.
    """

    images: list[ImageHeader]
    n_damaged: int
    n_unreadable: int


def read_images(folder: str | os.PathLike[str]) -> FoundImages:
    """The images below a folder, and the number of unreadable files.

    Files without pixels (DICOMDIR, reports) are left out.

    Raises:
        InputError: the folder does not exist, or holds no DICOM image.
    """
    if not Path(folder).is_dir():
        found = "is a file" if Path(folder).exists() else "does not exist"
        raise InputError(f"{folder}: {found}; expected a folder of DICOM images, pass it to --dicom")
    images: dict[str, ImageHeader] = {}
    unreadable: list[OSError] = []
    n_damaged = 0
    for path in dicom_files(folder, unreadable):
        try:
            image = read_header(path)
        except ModuleNotFoundError:
            raise
        except Exception:  # pydicom may raise anything on damaged bytes
            n_damaged += 1
            continue
        if image.rows and image.series_uid:
            images.setdefault(image.sop_uid or str(path), image)
        elif not image.sop_class_uid or image.sop_class_uid.startswith(MR_CLASSES):
            n_damaged += 1
    if not images:
        damaged = f", {n_damaged} damaged DICOM files" if n_damaged else ""
        closed = f", {len(unreadable)} files and folders that cannot be read" if unreadable else ""
        hint = "; check their permissions" if closed else ""
        raise InputError(
            f"{folder}: holds no DICOM image{damaged}{closed}; expected the folder that the scanner exported{hint}"
        )
    return FoundImages(list(images.values()), n_damaged, len(unreadable))


def read_header(path: Path) -> ImageHeader:
    """The header of a DICOM image.

    Raises:
        Exception: whatever pydicom raises for a damaged file.
    """
    # Pixels are not read. pydicom parses values on access, so both reading and parsing happen inside the silent block:
    # its messages about a bad value quote that value.
    from pydicom import dcmread

    with quiet_pydicom(), path.open("rb") as stream:
        header = dcmread(stream, stop_before_pixels=True)
        n_left = os.fstat(stream.fileno()).st_size - stream.tell()
        return _header(path, header, n_left)


@contextmanager
def quiet_pydicom() -> Iterator[None]:
    """Suppress pydicom's warnings and log lines, which quote values of headers."""
    logger = logging.getLogger("pydicom")
    before, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.disabled = before


def _header(path: Path, header: Dataset, n_left: int) -> ImageHeader:
    """The reduced header of an image.

    Args:
        path: path of the file.
        header: header as read by pydicom.
        n_left: bytes of the file from the pixels on.
    """
    texts = {ours: _value(header, name, str) or "" for ours, name in TEXTS.items()}
    numbers = {ours: _value(header, name, _number) for ours, name in NUMBERS.items()}
    lists = {ours: _value(header, name, _words) or () for ours, name in LISTS.items()}
    position, axes = _value(header, POSITION, _vector), _value(header, AXES, _vector)
    meta = getattr(header, "file_meta", None)
    if meta is not None and not texts["sop_class_uid"]:  # DICOMDIR
        texts["sop_class_uid"] = _value(meta, "MediaStorageSOPClassUID", str) or ""
    fields: dict[str, Any] = {**texts, **numbers, **lists}
    return ImageHeader(
        path=path,
        position_mm=position if _is_vector(position, 3, FARTHEST_MM) else None,
        axes=axes.reshape(2, 3) if axes is not None and _is_vector(axes, 6, 1 + 1e-3) else None,
        is_cut=_is_cut(header, n_left, numbers),
        **fields,
    )


def _value(header: Dataset, name: str, parse: Callable[[Any], Value]) -> Value | None:
    """A value of a header; None if it is absent, empty or invalid."""
    try:
        found = header.get(name)
        return None if found is None or found == "" else parse(found)
    except (TypeError, ValueError, KeyError, AttributeError, NotImplementedError, OverflowError):
        return None


def _number(found: Any) -> float:
    number = float(found)
    if not math.isfinite(number):
        raise ValueError("not finite")
    return number


def _words(found: Any) -> tuple[str, ...]:
    return (found,) if isinstance(found, str) else tuple(map(str, found))


def _vector(found: Any) -> NDArray[np.float64]:
    return np.array([_number(x) for x in found], dtype=np.float64)


def _is_vector(found: NDArray[np.float64] | None, size: int, most: float) -> bool:
    """Whether a vector has `size` numbers, none of them beyond `most`."""
    return found is not None and found.size == size and bool(np.abs(found).max() <= most)


def _is_cut(header: Dataset, n_left: int, numbers: dict[str, float | None]) -> bool:
    """Whether the file is too short for its pixels; False for compressed pixels, whose size is unknown.

    Args:
        header: header of the file.
        n_left: bytes of the file from the pixels on.
        numbers: see `NUMBERS`.
    """
    rows, columns, bits = (numbers[name] or 0 for name in ("rows", "columns", "bits"))
    meta = getattr(header, "file_meta", None)
    syntax = None if meta is None else meta.get("TransferSyntaxUID")
    if syntax is None or syntax.is_compressed or syntax.is_deflated:
        return False
    return n_left < rows * columns * bits / 8 * (numbers["n_frames"] or 1)
