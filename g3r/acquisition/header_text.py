"""Free text of NIfTI headers, which may name a patient, a date or a folder: carried on only on request."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import nibabel as nib

from g3r.acquisition.nifti import open_nifti

TEXT_FIELDS = ("descrip", "aux_file", "intent_name", "db_name", "data_type")
"""Text fields of a NIfTI-1 header; NIfTI-2 has the first three."""


@dataclass(frozen=True)
class HeaderText:
    """The free text of a header.

    Args:
        fields: `TEXT_FIELDS` that are not empty.
        extensions: code and bytes of each (2: DICOM, 4: AFNI, 6: a comment).
    """

    fields: Mapping[str, str] = field(default_factory=dict)
    extensions: tuple[tuple[int, bytes], ...] = ()

    def record(self) -> dict[str, Any]:
        """For run.json."""
        texts = [
            {"code": code, "text": content.decode("utf-8", "backslashreplace")} for code, content in self.extensions
        ]
        return {"fields": dict(self.fields), "extensions": texts}

    def put_into(self, image: nib.Nifti1Image) -> None:
        """Write it into the header of an image."""
        for name, value in self.fields.items():
            image.header[name] = value.encode("utf-8", "surrogateescape")
        for code, content in self.extensions:
            image.header.extensions.append(nib.nifti1.Nifti1Extension(code, content))


def read_header_text(path: str | os.PathLike[str]) -> HeaderText:
    """The free text of a NIfTI header.

    Raises:
        InputError: a file that cannot be read.
    """
    header = open_nifti(path)[0].header
    fields = {}
    for name in TEXT_FIELDS:
        if name in header.keys():  # noqa: SIM118 - a header is no dict
            value = bytes(header[name].item()).rstrip(b"\0").decode("utf-8", "surrogateescape")
            if value:
                fields[name] = value
    return HeaderText(fields, tuple(_code_and_bytes(one) for one in header.extensions))


def _code_and_bytes(extension: Any) -> tuple[int, bytes]:
    """An extension as in the file; nibabel's interpretation of its content depends on the version."""
    written = BytesIO()
    extension.write_to(written, False)
    return int(extension.get_code()), written.getvalue()[8:].rstrip(b"\0")
