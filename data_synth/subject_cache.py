"""Synthetic subjects, and a folder that keeps them: made once, read in a hundredth of the time."""

from __future__ import annotations

import hashlib
import os
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_synth.motion import ResidualKind
from g3r.errors import InputError

RECIPE_VERSION = 1
"""Raised whenever the synthesis changes, so that no subject of another recipe is taken for one of this."""


@dataclass(frozen=True)
class SyntheticSubject:
    """What the network sees and should answer, [I, J, K] on the truth's grid, in normalised intensities."""

    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    sharp: NDArray[np.float32]
    truth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    affine: NDArray[np.float64]
    name: str
    n_stacks: int
    residual: ResidualKind


class KeptSubjects:
    """Subjects as files in a folder; volumes as float16, which is finer than their noise.

    Args:
        folder: made where it is missing.
        spec: all that decides the subjects; another recipe has files of other names.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(self, folder: str | Path, spec: str) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another cache") from None
        self.prefix = hashlib.sha256(f"{RECIPE_VERSION} {spec}".encode()).hexdigest()[:12]

    def _path(self, epoch: int, index: int) -> Path:
        return self.folder / f"{self.prefix}-{epoch:05d}-{index:05d}.npz"

    def load(self, epoch: int, index: int) -> SyntheticSubject | None:
        """The subject of that number, or None where it is not kept (or its file is damaged)."""
        try:
            with np.load(self._path(epoch, index), allow_pickle=False) as file:
                found = {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        values = {}
        for field in fields(SyntheticSubject):
            value = found[field.name]
            if value.ndim == 0:
                values[field.name] = value.item()
            else:
                values[field.name] = value.astype(np.float32) if value.dtype == np.float16 else value
        return SyntheticSubject(**values)

    def save(self, epoch: int, index: int, subject: SyntheticSubject) -> None:
        """Keep a subject; its file appears whole or not at all.

        Raises:
            InputError: the folder is full or cannot be written.
        """
        arrays = {}
        for field in fields(SyntheticSubject):
            value = np.asarray(getattr(subject, field.name))
            arrays[field.name] = value.astype(np.float16) if value.dtype == np.float32 else value
        path = self._path(epoch, index)
        beside = path.with_suffix(f".{os.getpid()}")
        try:
            with open(beside, "wb") as stream:
                np.savez(stream, **arrays)  # type: ignore[arg-type]
            os.replace(beside, path)
        except OSError as error:
            beside.unlink(missing_ok=True)
            raise InputError(f"{path}: cannot be written ({error.strerror}); free some space") from None
