"""Sidecars: the JSON file beside an image, as dcm2niix and BIDS write it, with the slice geometry of the scanner.

Only a few keys are read. If the value of one makes no sense, the file is refused, since it would decide the PSF. All
other keys are ignored; they may name the patient, and nothing of them is kept.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from g3r.acquisition.nifti import NIFTI_ENDINGS
from g3r.acquisition.psf import THICKNESS_RANGE_MM
from g3r.errors import InputError, one_line

MAX_SIDECAR_BYTES = 10_000_000

SPACING_RANGE_MM = (0.01, 100.0)
"""Allowed slice spacing, wider than for a stack: the spacing is compared with the image's header anyway."""

PHASE_RESOLUTION_RANGE = (0.1, 1.0)
"""Allowed phase resolution. A tenth of k-space would be a PSF of 12 pixels; a percentage is above the range."""

DIRECTION_KEYS = ("PhaseEncodingDirection", "PhaseEncodingAxis")
"""Keys of the phase-encoding axis of the image file: i, j or k, with a sign (-), an unknown sign (?) or none. The first
key that is present counts."""

DICOM_KEY = "InPlanePhaseEncodingDirectionDICOM"

READ_KEYS = ("SliceThickness", "SpacingBetweenSlices", "PhaseResolution", *DIRECTION_KEYS, DICOM_KEY)
"""All keys that are read."""

Axis = Literal["i", "j", "k"]

AXES: tuple[Axis, ...] = ("i", "j", "k")
"""The axes of an image file, in order."""

AXIS_OF_DICOM: dict[str, Axis] = {"ROW": "i", "COL": "j", "COLUMN": "j"}
"""Axis of dcm2niix' file for each word of DICOM. The direction along a row of the DICOM image (columns count up) is the
first axis. dcm2niix may flip the second axis but does not exchange the two for a stack of slices."""


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """Contents of a sidecar; None for what it lacks.

    Attributes:
        name: of the file.
        thickness_mm: `SliceThickness`.
        spacing_mm: `SpacingBetweenSlices`, from centre to centre.
        phase_resolution: `PhaseResolution`, the share of k-space that was filled along the phase-encoding axis.
        phase_axis: of the image file.
        dicom_phase_axis: the same from `DICOM_KEY`, for a file whose slices are along the third axis, as dcm2niix
            writes it.
    """

    name: str
    thickness_mm: float | None = None
    spacing_mm: float | None = None
    phase_resolution: float | None = None
    phase_axis: Axis | None = None
    dicom_phase_axis: Axis | None = None

    def phase_axis_of(self, slice_axis: int) -> Axis | None:
        """The phase-encoding axis of a file whose slices are along `slice_axis` (0 to 2).

        `PhaseEncodingDirection` refers to the file's axes. DICOM's word refers to the scanner's images, so it is used
        only if the file has its axes as dcm2niix wrote them.
        """
        if self.phase_axis is not None:
            return self.phase_axis
        return self.dicom_phase_axis if slice_axis == 2 else None


def sidecar_path(image: str | os.PathLike[str]) -> Path:
    """Where the sidecar of an image is: X.json beside X.nii.gz, X.nii or X.hdr."""
    path = Path(image)
    name = path.name[:-3] if path.name.lower().endswith(".gz") else path.name
    if name.lower().endswith(NIFTI_ENDINGS):
        name = name[:-4]
    return path.parent / f"{name}.json"


def read_sidecar(path: str | os.PathLike[str]) -> Sidecar | None:
    """Read a sidecar; None where there is no such file.

    Raises:
        InputError: it cannot be read, is no JSON object, or a key that is read has a value that makes no sense.
    """
    path = Path(path)
    content = _content(path)
    if content is None:
        return None
    # free text may be in any 8-bit code, with line breaks and tabs; the keys that are read are ASCII
    text = content.decode("utf-8-sig", errors="replace")
    try:
        found = json.loads(text, strict=False)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path.name}: is not JSON ({one_line(error)}); expected what dcm2niix writes, mend or remove the file"
        ) from None
    if not isinstance(found, dict):
        raise InputError(
            f"{path.name}: holds {_shown(found)}; expected an object {{...}} as dcm2niix writes it, mend or remove "
            "the file"
        )
    return Sidecar(
        name=path.name,
        thickness_mm=_number(found, "SliceThickness", THICKNESS_RANGE_MM, "mm", path.name),
        spacing_mm=_number(found, "SpacingBetweenSlices", SPACING_RANGE_MM, "mm", path.name),
        phase_resolution=_number(found, "PhaseResolution", PHASE_RESOLUTION_RANGE, "(a share)", path.name),
        phase_axis=_phase_axis(found, path.name),
        dicom_phase_axis=_dicom_phase_axis(found, path.name),
    )


def _content(path: Path) -> bytes | None:
    """The bytes of a file; None where there is none.

    Raises:
        InputError: it is there and cannot be read, or is too large.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or device"
            raise InputError(f"{path}: is {kind}; expected the JSON file of the image beside it, move it away")
        if status.st_size > MAX_SIDECAR_BYTES:
            raise InputError(
                f"{path.name}: has {status.st_size / 1e6:.0f} MB; expected a JSON file of at most "
                f"{MAX_SIDECAR_BYTES / 1e6:.0f} MB beside the image, move it away"
            )
        with path.open("rb") as stream:
            return stream.read(MAX_SIDECAR_BYTES)
    except FileNotFoundError:
        if not path.is_symlink():
            return None
        raise InputError(f"{path}: is a link to nothing; fetch what it links to, or remove it") from None
    except (OSError, ValueError) as error:
        # a name one letter too long for the system, or with a zero byte: there can be no such file
        if isinstance(error, ValueError) or error.errno == errno.ENAMETOOLONG:
            return None
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions, or move it away") from None


def _number(found: dict[str, Any], key: str, allowed: tuple[float, float], unit: str, name: str) -> float | None:
    """A number of the sidecar; None where it is absent or null.

    Args:
        found: the sidecar.
        key: of the number.
        allowed: least and largest value.
        unit: for messages.
        name: of the file, for messages.

    Raises:
        InputError: not a number, or out of range.
    """
    value = found.get(key)
    if value is None:
        return None
    low, high = allowed
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and low <= value <= high):  # what is not a number (NaN) compares as false
        raise InputError(
            f"{name}: {key} is {_shown(value)}; expected a number from {low:g} to {high:g} {unit}, mend it or remove "
            "the key"
        )
    return float(value)


def _phase_axis(found: dict[str, Any], name: str) -> Axis | None:
    """The axis in the file that the first of `DIRECTION_KEYS` names.

    Raises:
        InputError: a value that is no axis.
    """
    for key in DIRECTION_KEYS:
        value = found.get(key)
        if value is None:
            continue
        for axis in AXES:
            if value in (axis, f"{axis}-", f"{axis}?"):
                return axis
        raise InputError(
            f"{name}: {key} is {_shown(value)}; expected i, j or k, with - or ? behind it or nothing, mend it or "
            "remove the key"
        )
    return None


def _dicom_phase_axis(found: dict[str, Any], name: str) -> Axis | None:
    """The axis that `DICOM_KEY` names, in a file as dcm2niix writes it.

    Raises:
        InputError: neither ROW nor COL.
    """
    value = found.get(DICOM_KEY)
    if value is None:
        return None
    if not (isinstance(value, str) and value.strip() in AXIS_OF_DICOM):
        raise InputError(f"{name}: {DICOM_KEY} is {_shown(value)}; expected ROW or COL, mend it or remove the key")
    return AXIS_OF_DICOM[value.strip()]


def _shown(value: object) -> str:
    """A value for messages, in a few characters."""
    if isinstance(value, dict | list):
        return "a list" if isinstance(value, list) else "an object"
    return f"{value!r:.40}"
