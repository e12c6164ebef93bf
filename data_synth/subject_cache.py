"""Synthetic subjects of the prior network, and a folder that keeps them: reading one takes a hundredth of the time."""

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

SYNTHESIS_VERSION = 6
"""Raised whenever the synthesis changes, so that subjects of an earlier one are not taken. Slices have a version of
their own (`SIMULATOR_VERSION`), which counts as well."""


@dataclass(frozen=True, kw_only=True)
class SyntheticSubject:
    """Input and target of the prior network, on the truth's grid, in normalised intensities.

    Args:
        coarse: [I, J, K] V_coarse.
        density: [I, J, K] M_rho, over whole slices.
        share: [I, J, K] of the density whose masks say brain.
        sharp: [I, J, K] V_sharp.
        template: [I, J, K] an atlas template fitted to what the slices saw.
        outline: [I, J, K] share of brain in it.
        truth: [I, J, K], zero outside the mask.
        mask: [I, J, K] the head.
        n_stacks: stacks that it was made from.
        thickness_mm: of the slices, which is that of all stacks.
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
    """Subjects as files in a folder; volumes as float16, which is finer than their noise.

    Args:
        folder: made where it is missing.
        spec: all that decides the subjects; another spec has files of other names.

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
        """The subject of that number, or None where it is not kept, or its file is damaged or lacks a field."""
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
        """Keep a subject; its file appears whole or not at all.

        Args:
            epoch: of the subject's number.
            index: of the subject's number.
            subject: to keep.

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
