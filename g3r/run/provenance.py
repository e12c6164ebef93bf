"""Provenance of a result: its input files by their SHA-256, and the settings."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from g3r._version import __version__
from g3r.errors import InputError
from g3r.run.json_record import to_plain


@dataclass(frozen=True)
class FileHash:
    """A file by its name, without its folder, and the SHA-256 of its bytes."""

    name: str
    sha256: str

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> FileHash:
        """Read a file and hash it.

        Raises:
            InputError: it cannot be read.
        """
        try:
            with Path(path).open("rb") as file:
                return cls(Path(path).name, hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None


def provenance(settings: Any, files: Mapping[str, FileHash], **further: object) -> dict[str, str]:
    """Everything that determines a result, by name; a run may only resume a run with equal provenance.

    Args:
        settings: dataclass of settings.
        files: inputs by their role.
        further: other determining values, by name.
    """
    found = {name: file.sha256 for name, file in files.items()}
    found |= {f"setting {name}": repr(value) for name, value in _leaves(to_plain(settings))}
    return found | {name: str(value) for name, value in further.items()} | {"g3r version": __version__}


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found += _leaves(value, f"{prefix}{name}.")
        else:
            found.append((prefix + name, value))
    return found
