"""A volume as a classic MR series of its source examination: one file per slice."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g3r._version import __version__
from g3r.dicom.headers import ImageHeader, quiet_pydicom
from g3r.dicom.study import SourceStudy
from g3r.errors import InputError
from g3r.geometry.lps import LPS_FROM_RAS
from g3r.run.output_folder import FOUND_ON_DISKS, OutputFolder

if TYPE_CHECKING:
    from pydicom.dataset import Dataset
    from pydicom.uid import UID

DESCRIPTION = "g3r reconstruction, derived, not for diagnosis"

DERIVATION = (
    "Slice-to-volume reconstruction of stacks of thick slices by g3r {version}: slices were moved to one pose of the "
    "head, and what they do not determine was estimated from other brains. {space}. For research only, not for "
    "diagnosis."
)

SPACES = {
    True: "In the frame of the source images",
    False: "In standard orientation, not in the frame of the source images",
}
"""Words for the space, by whether the volume is in scanner space."""

FIRST_NUMBER = 9001
"""Least number of the series, above the numbers that scanners use."""

MAX_STORED = 2**16 - 1

BRIGHT_PERCENTILE = 99.9
"""Percentile of the positive values at which the window for viewers ends."""


@dataclass(frozen=True)
class StoredValues:
    """Values quantised to whole numbers: value = slope * number + intercept, within half a slope.

    Args:
        numbers: [I, J, K] uint16.
        slope, intercept: as texts of at most 16 characters, the limit of DICOM.
    """

    numbers: NDArray[np.uint16]
    slope: str
    intercept: str

    @classmethod
    def of(cls, values: NDArray[np.floating]) -> StoredValues:
        """The values in the finest quantisation of 16 bits."""
        from pydicom.valuerep import format_number_as_ds

        low, high = min(float(values.min()), 0.0), float(values.max())
        intercept = format_number_as_ds(low)
        slope = format_number_as_ds((high - low) / MAX_STORED or 1.0)
        numbers = np.rint((values.astype(np.float64) - float(intercept)) / float(slope))
        return cls(np.clip(numbers, 0, MAX_STORED).astype(np.uint16), slope, intercept)


def check_new_folder(folder: str | os.PathLike[str]) -> None:
    """Refuse a folder into which a series cannot be written.

    Raises:
        InputError: it is not empty, is a file, is below a file, or cannot be created.
    """
    path = Path(folder)
    try:
        if path.is_dir() and any(one.name not in FOUND_ON_DISKS for one in path.iterdir()):
            raise InputError(f"{path}: is not empty; expected a new or empty folder, choose another --dicom-out")
        if os.path.lexists(path) and not path.is_dir():
            raise InputError(f"{path}: is not a folder; expected a new or empty one, choose another --dicom-out")
        parent = next(parent for parent in path.absolute().parents if parent.exists())
        if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
            raise InputError(f"{path}: cannot be made in {parent}; choose another --dicom-out")
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be written ({found}); choose another --dicom-out") from None


def write_volume_series(
    folder: str | os.PathLike[str],
    volume: NDArray[np.floating],
    affine: NDArray[np.float64],
    study: SourceStudy,
    *,
    in_scanner_space: bool,
    remark: str = "",
) -> None:
    """Write a volume as a series of its examination; the folder appears whole or not at all.

    The files name the patient, because they belong to the examination. No other output of g3r does.

    Args:
        folder: folder to write, new or empty.
        volume: [I, J, K].
        affine: [4, 4] RAS+ mm from index, right-handed.
        study: examination that it was made from.
        in_scanner_space: whether it is in the frame of the study's images.
        remark: remark for viewers, after the standard image comment.

    Raises:
        InputError: the folder is not empty or cannot be written.
    """
    check_new_folder(folder)
    try:
        with OutputFolder(folder) as output, output.result() as staged:
            series = _series(study, in_scanner_space=in_scanner_space, remark=remark)
            for k, image in enumerate(_images(volume, affine, series)):
                image.save_as(staged / f"{k + 1:04d}.dcm", enforce_file_format=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written ({error.strerror or type(error).__name__}); the other results are complete, "
            "free some space or choose another --dicom-out"
        ) from None


def _images(volume: NDArray[np.floating], affine: NDArray[np.float64], series: Dataset) -> Iterator[Dataset]:
    """One image per slice along the third axis, in radiological orientation: right on the left, front on top.

    Args:
        volume: [I, J, K].
        affine: [4, 4] RAS+ mm from index.
        series: common elements of all images; elements that depend on the volume are added to it.
    """
    from pydicom.uid import generate_uid

    flipped = volume[::-1, ::-1]
    from_flipped = np.diag([-1.0, -1.0, 1.0, 1.0])
    from_flipped[:2, 3] = volume.shape[0] - 1, volume.shape[1] - 1
    lps = LPS_FROM_RAS @ affine @ from_flipped
    stored = StoredValues.of(flipped)
    _set_axes(series, lps)
    _set_values(series, flipped, stored)
    for k in range(volume.shape[2]):
        yield _slice(series, stored.numbers[:, :, k].T, lps @ [0, 0, k, 1], k + 1, generate_uid())


def _series(study: SourceStudy, *, in_scanner_space: bool, remark: str) -> Dataset:
    """Elements common to all images of the series that do not depend on the volume."""
    from pydicom.dataset import Dataset
    from pydicom.uid import MRImageStorage, generate_uid

    one, now = Dataset(), datetime.now()
    with quiet_pydicom():
        one.update(study.identity)
    one.SOPClassUID = MRImageStorage
    one.SeriesInstanceUID = generate_uid()
    one.FrameOfReferenceUID = (study.frame_uid if in_scanner_space else None) or generate_uid()
    one.PositionReferenceIndicator = one.PatientPosition = one.Laterality = ""
    one.Modality = "MR"
    one.SeriesNumber = max(FIRST_NUMBER, *(int(image.number or 0) + 1 for image in study.images))
    one.SeriesDescription = DESCRIPTION
    one.SeriesDate = one.ContentDate = one.InstanceCreationDate = now.strftime("%Y%m%d")
    one.SeriesTime = one.ContentTime = one.InstanceCreationTime = now.strftime("%H%M%S")
    one.Manufacturer, one.ManufacturerModelName, one.SoftwareVersions = "g3r", "g3r", f"g3r {__version__}"
    one.ImageType = ["DERIVED", "SECONDARY", "OTHER"]
    one.DerivationDescription = DERIVATION.format(version=__version__, space=SPACES[in_scanner_space])
    one.ImageComments = "; ".join(filter(None, ("For research only, not for diagnosis", remark)))
    one.BurnedInAnnotation = "NO"
    # research mode: no pulse sequence made these images
    one.ScanningSequence, one.SequenceVariant, one.ScanOptions = "RM", "NONE", ""
    one.MRAcquisitionType = "3D"
    one.EchoTime = one.RepetitionTime = one.EchoTrainLength = one.AcquisitionNumber = None
    _set_references(one, study.images)
    return one


def _set_axes(one: Dataset, lps: NDArray[np.float64]) -> None:
    """Set directions and distances of pixels and slices, from the affine [4, 4] that maps index to patient's frame."""
    spacing_mm = np.linalg.norm(lps[:3, :3], axis=0)
    one.PixelSpacing = [_decimal(spacing_mm[1]), _decimal(spacing_mm[0])]
    one.SliceThickness = one.SpacingBetweenSlices = _decimal(spacing_mm[2])
    one.ImageOrientationPatient = [_decimal(x) for x in (lps[:3, :2] / spacing_mm[:2]).T.ravel()]


def _set_references(one: Dataset, images: tuple[ImageHeader, ...]) -> None:
    """Refer to every image that the volume was made from, one by one and by series."""
    from pydicom.dataset import Dataset

    references: dict[str, list[Dataset]] = {}
    for image in images:
        reference = Dataset()
        reference.ReferencedSOPClassUID, reference.ReferencedSOPInstanceUID = image.sop_class_uid, image.sop_uid
        references.setdefault(image.series_uid, []).append(reference)
    one.SourceImageSequence = [reference for several in references.values() for reference in several]
    series = []
    for uid, several in references.items():
        own = Dataset()
        own.SeriesInstanceUID, own.ReferencedInstanceSequence = uid, several
        series.append(own)
    one.ReferencedSeriesSequence = series


def _set_values(one: Dataset, values: NDArray[np.floating], stored: StoredValues) -> None:
    """Set the mapping from numbers to values, and the window for viewers."""
    one.RescaleSlope, one.RescaleIntercept, one.RescaleType = stored.slope, stored.intercept, "US"
    positive = values[values > 0]
    bright = float(np.percentile(positive, BRIGHT_PERCENTILE)) if positive.size else 1.0
    one.WindowCenter, one.WindowWidth = _decimal(bright / 2), _decimal(bright)
    one.SamplesPerPixel, one.PhotometricInterpretation = 1, "MONOCHROME2"
    one.BitsAllocated, one.BitsStored, one.HighBit, one.PixelRepresentation = 16, 16, 15, 0


def _slice(
    series: Dataset, numbers: NDArray[np.uint16], position_mm: NDArray[np.float64], instance: int, uid: UID
) -> Dataset:
    """One image of the series.

    Args:
        series: common elements of all images.
        numbers: [rows, columns].
        position_mm: position of the centre of the first pixel.
        instance: number of the image.
        uid: UID of the image.
    """
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, MRImageStorage

    one = Dataset()
    one.update(series)
    one.file_meta = FileMetaDataset()
    one.file_meta.MediaStorageSOPClassUID, one.file_meta.MediaStorageSOPInstanceUID = MRImageStorage, uid
    one.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    one.SOPInstanceUID, one.InstanceNumber = uid, instance
    one.ImagePositionPatient = [_decimal(x) for x in position_mm[:3]]
    one.Rows, one.Columns = numbers.shape
    one.PixelData = np.ascontiguousarray(numbers, dtype="<u2").tobytes()
    return one


def _decimal(value: float) -> str:
    """A number as a DICOM decimal string of at most 16 characters."""
    from pydicom.valuerep import format_number_as_ds

    return format_number_as_ds(float(value))
