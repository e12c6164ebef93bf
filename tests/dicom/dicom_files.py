"""Classic MR series as a scanner would export them, written from simulated stacks by pydicom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pydicom = pytest.importorskip("pydicom", reason="pydicom is not installed; the dev extra brings it")
pytest.importorskip("dcm2niix", reason="dcm2niix is not installed; the dev extra brings it")

generate_uid = pydicom.uid.generate_uid


def decimal(value: float) -> str:
    """A number as a DICOM decimal string."""
    return pydicom.valuerep.format_number_as_ds(float(value))


LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])

CANARY = "Xenobia"
"""Word that is part of every text about the patient and occurs nowhere else."""

PERSONAL: dict[str, str] = {
    "PatientName": f"{CANARY}^Q",
    "PatientID": f"ID-{CANARY}",
    "PatientBirthDate": "19870213",
    "PatientSex": "F",
    "PatientAge": "039Y",
    "OtherPatientIDs": f"OTHER-{CANARY}",
    "PatientAddress": f"1 {CANARY} Street",
    "PatientMotherBirthName": f"{CANARY}^Mother",
    "PatientComments": f"about {CANARY}",
    "AdditionalPatientHistory": f"history of {CANARY}",
    "EthnicGroup": f"{CANARY}",
    "Occupation": f"{CANARY}",
    "InstitutionName": f"Hospital of {CANARY}",
    "InstitutionAddress": f"At {CANARY}",
    "InstitutionalDepartmentName": f"Ward {CANARY}",
    "StationName": f"{CANARY}-1",
    "ReferringPhysicianName": f"{CANARY}^Doctor",
    "PerformingPhysicianName": f"{CANARY}^Performs",
    "OperatorsName": f"{CANARY}^Operates",
    "AccessionNumber": f"A-{CANARY}",
    "StudyID": f"S-{CANARY}",
    "StudyDescription": f"Fetal MRI of {CANARY}",
    "ProtocolName": f"t2 of {CANARY}",
    "RequestedProcedureDescription": f"asked for {CANARY}",
    "ImageComments": f"comment on {CANARY}",
    "DeviceSerialNumber": f"{CANARY}",
    "StudyDate": "20260814",
    "SeriesDate": "20260814",
    "AcquisitionDate": "20260814",
    "ContentDate": "20260814",
    "StudyTime": "073519",
}

TRACES = [word.encode() for word in (CANARY, "19870213", "20260814", "2026-08-14", "073519", "07:35:19", "DOE SERIES")]
"""Texts that must not occur anywhere in a result."""

SCANNER: dict[str, Any] = {
    "Modality": "MR",
    "Manufacturer": "SIEMENS",
    "ManufacturerModelName": "Simulated",
    "ImageType": ["ORIGINAL", "PRIMARY", "M", "ND"],
    "ScanningSequence": "SE",
    "SequenceVariant": "SK",
    "ScanOptions": "",
    "MRAcquisitionType": "2D",
    "MagneticFieldStrength": 1.5,
    "EchoTime": 90,
    "RepetitionTime": 1200,
    "EchoTrainLength": 100,
    "FlipAngle": 120,
    "PatientPosition": "HFS",
}


@dataclass
class Study:
    """Common attributes of all series of one examination."""

    folder: Path
    personal: dict[str, str] = field(default_factory=lambda: dict(PERSONAL))
    uid: str = field(default_factory=generate_uid)
    frame_uid: str = field(default_factory=generate_uid)
    n_images: int = 0

    def write(
        self,
        image: NDArray[Any],
        affine: NDArray[np.float64],
        number: int,
        *,
        thickness_mm: float = 4.0,
        missing: Sequence[int] = (),
        interleaved: bool = True,
        **tags: Any,
    ) -> list[Path]:
        """Write a stack as one series, one file for each slice.

        Args:
            image: [I, J, K] integers.
            affine: [4, 4] RAS+ mm from index.
            number: of the series.
            thickness_mm: of a slice.
            missing: indices of slices that are left out.
            interleaved: whether instance numbers run over even slices, then odd ones.
            tags: replacements for those of `SCANNER`.
        """
        n_slices = image.shape[2]
        order = [*range(0, n_slices, 2), *range(1, n_slices, 2)] if interleaved else [*range(n_slices)]
        series_uid, paths = generate_uid(), []
        lps = LPS_FROM_RAS @ affine
        spacing = np.linalg.norm(lps[:3, :3], axis=0)
        for instance, k in enumerate(order, start=1):
            if k in missing:
                continue
            self.n_images += 1
            # files of all series are in one folder, with uninformative names
            path = self.folder / f"IM{self.n_images:05d}"
            one = _new_image(path)
            for name, value in {**self.personal, **SCANNER, "SeriesDescription": "DOE SERIES"}.items():
                setattr(one, name, value)
            one.StudyInstanceUID, one.SeriesInstanceUID = self.uid, series_uid
            one.FrameOfReferenceUID = self.frame_uid
            one.SeriesNumber, one.InstanceNumber, one.AcquisitionNumber = number, instance, 1
            one.AcquisitionTime = f"08{number % 60:02d}{instance % 60:02d}.{instance // 60:06d}"
            one.SliceThickness = decimal(thickness_mm)
            one.SpacingBetweenSlices = decimal(spacing[2])
            one.PixelSpacing = [decimal(spacing[1]), decimal(spacing[0])]
            axes = (lps[:3, :2] / spacing[:2]).T.ravel()
            one.ImageOrientationPatient = [decimal(x) for x in axes]
            one.ImagePositionPatient = [decimal(x) for x in (lps @ [0, 0, k, 1])[:3]]
            for name, value in tags.items():
                setattr(one, name, value)
            _set_pixels(one, image[:, :, k].T)
            one.save_as(path, enforce_file_format=True)
            paths.append(path)
        return paths


def _new_image(path: Path) -> Any:
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID = pydicom.uid.MRImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    one = pydicom.dataset.FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    one.SOPClassUID, one.SOPInstanceUID = pydicom.uid.MRImageStorage, meta.MediaStorageSOPInstanceUID
    return one


def _set_pixels(one: Any, pixels: NDArray[Any]) -> None:
    one.Rows, one.Columns = pixels.shape
    one.SamplesPerPixel, one.PhotometricInterpretation = 1, "MONOCHROME2"
    one.BitsAllocated, one.BitsStored, one.HighBit, one.PixelRepresentation = 16, 12, 11, 0
    one.PixelData = np.ascontiguousarray(pixels, dtype="<u2").tobytes()
