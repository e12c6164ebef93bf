"""Synthetic subjects of the prior network, and a file cache of them; reading is about 100 times faster than making."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_synth.simulator import SIMULATOR_VERSION
from g3r.errors import InputError
from g3r.run.atomic_file import atomic_path

SYNTHESIS_VERSION = 7
"""Version of the synthesis, raised whenever it changes, so that cached subjects of an earlier version are not used.
Cached subjects also depend on the version of the simulated slices, `SIMULATOR_VERSION`."""


@dataclass(frozen=True, kw_only=True)
class SyntheticSubject:
    """Input and target of the prior network, on the truth's grid, in normalised intensities.

    Args:
        coarse: [I, J, K] V_coarse.
        density: [I, J, K] M_rho, over whole slices.
        share: [I, J, K] brain share: masked density over density.
        sharp: [I, J, K] V_sharp.
        template: [I, J, K] an atlas template fitted to the seen part of the head.
        outline: [I, J, K] share of brain in the fitted template.
        truth: [I, J, K], zero outside the mask.
        mask: [I, J, K] the head.
        n_stacks: number of stacks.
        thickness_mm: slice thickness, the same for all stacks.
    """

    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    share: NDArray[np.float32]
    sharp: NDArray[np.float32]
    template: NDArray[np.float32]
    outline: NDArray[np.float32]
    truth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    n_stacks: int
    thickness_mm: float


class SubjectCache:
    """Cache of subjects as files in a folder; volumes are float16, whose resolution is finer than their noise.

    Args:
        folder: created if it does not exist.
        spec: everything that determines the subjects; it is part of the file names.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(self, folder: str | Path, spec: str) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another cache") from None
        self.prefix = hashlib.sha256(f"{SIMULATOR_VERSION} {SYNTHESIS_VERSION} {spec}".encode()).hexdigest()[:12]

    def _path(self, epoch: int, index: int) -> Path:
        return self.folder / f"{self.prefix}-{epoch:05d}-{index:05d}.npz"

    def load(self, epoch: int, index: int) -> SyntheticSubject | None:
        """The subject (epoch, index), or None if it is not stored or its file is damaged or lacks a field."""
        try:
            with self._path(epoch, index).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                found = {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        values = {}
        for field in fields(SyntheticSubject):
            if field.name not in found:
                return None  # of an earlier version
            value = found[field.name]
            if value.ndim == 0:
                values[field.name] = value.item()
            else:
                values[field.name] = value.astype(np.float32) if value.dtype == np.float16 else value
        return SyntheticSubject(**values)

    def save(self, epoch: int, index: int, subject: SyntheticSubject) -> None:
        """Store a subject; its file is written atomically.

        Args:
            epoch: epoch of the subject.
            index: index of the subject in its epoch.
            subject: to store.

        Raises:
            InputError: the folder is full or cannot be written.
        """
        arrays = {}
        for field in fields(SyntheticSubject):
            value = np.asarray(getattr(subject, field.name))
            arrays[field.name] = value.astype(np.float16) if value.dtype == np.float32 else value
        path = self._path(epoch, index)
        try:
            with atomic_path(path) as temporary:
                np.savez(temporary, **arrays)  # type: ignore[arg-type]
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); free some space") from None
