"""The examination of a volume: the elements that its own series repeats, and the images that it refers to."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from g3r.dicom.headers import ImageHeader, quiet_pydicom, read_images
from g3r.errors import InputError

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

PATIENT = (
    "PatientName",
    "PatientID",
    "IssuerOfPatientID",
    "TypeOfPatientID",
    "IssuerOfPatientIDQualifiersSequence",
    "OtherPatientIDsSequence",
    "PatientBirthDate",
    "PatientBirthTime",
    "PatientSex",
    "PatientIdentityRemoved",
    "DeidentificationMethod",
    "DeidentificationMethodCodeSequence",
)
"""Elements of the patient module that identify the patient, by which an archive files the series. Histories and
addresses are not needed for that, and are not copied."""

STUDY = (
    "StudyInstanceUID",
    "StudyDate",
    "StudyTime",
    "StudyID",
    "StudyDescription",
    "AccessionNumber",
    "ReferringPhysicianName",
    "PatientAge",
    "PatientSize",
    "PatientWeight",
)
"""Elements of the study modules, which are the same in every series of an examination."""

EMPTY_IF_ABSENT = (
    "PatientName",
    "PatientID",
    "PatientBirthDate",
    "PatientSex",
    "StudyDate",
    "StudyTime",
    "StudyID",
    "AccessionNumber",
    "ReferringPhysicianName",
)
"""Elements that an image must have, with or without a value (type 2)."""


@dataclass(frozen=True)
class SourceStudy:
    """An examination.

    Args:
        identity: the elements of `PATIENT` and `STUDY`, with their character set.
        images: images that the volume refers to.
    """

    identity: Dataset
    images: tuple[ImageHeader, ...]

    @property
    def frame_uid(self) -> str | None:
        """UID of the frame of reference, if all images share one."""
        found = {image.frame_uid for image in self.images}
        return found.pop() or None if len(found) == 1 else None


def study_of(images: Sequence[ImageHeader], named: str | os.PathLike[str]) -> SourceStudy:
    """The examination of the given images.

    Args:
        images: at least one.
        named: their folder, for messages.

    Raises:
        InputError: they are of several examinations, or the first file cannot be read any more.
    """
    n_studies = len({(image.study_uid, image.patient_id) for image in images})
    if n_studies > 1:
        raise InputError(f"{named}: holds {n_studies} examinations; expected the one that the volume is to join")
    from pydicom import dcmread
    from pydicom.dataset import Dataset

    identity = Dataset()
    try:
        with quiet_pydicom():
            header = dcmread(images[0].path, stop_before_pixels=True)
            for name in ("SpecificCharacterSet", *PATIENT, *STUDY):
                if name in header:
                    identity[name] = header[name]
                elif name in EMPTY_IF_ABSENT:
                    setattr(identity, name, "")
    except Exception:  # pydicom may raise anything on damaged bytes
        raise InputError(f"{named}: the header of its first image cannot be read; export the images again") from None
    return SourceStudy(identity, tuple(images))


def read_study(folder: str | os.PathLike[str]) -> SourceStudy:
    """The examination in a folder of DICOM images.

    Raises:
        InputError: as `read_images` and `study_of`.
    """
    images = read_images(Path(folder)).images
    return study_of([image for image in images if image.modality == "MR"] or images, folder)
