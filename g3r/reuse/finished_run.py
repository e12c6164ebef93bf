"""The output folder of a finished run, read back."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from g3r.acquisition.images import Space, Volume, load_volume
from g3r.errors import InputError
from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose, VolumeGrid
from g3r.output.files import REUSE_NAME
from g3r.output.mixture import Mixture
from g3r.output.record import RegistrationRecord, RunRecord
from g3r.output.reuse_record import ReuseRecord


@dataclass(frozen=True)
class FinishedRun:
    """A finished run: its record, its geometry, and its other files on demand.

    Attributes:
        folder: output folder of the run.
        record: run.json.
        geometry: reuse.npz.
    """

    folder: Path
    record: RunRecord
    geometry: ReuseRecord

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> FinishedRun:
        """Read a folder that g3r-infer wrote.

        Raises:
            InputError: the folder does not exist, or files in it are missing, damaged or of another version.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise InputError(f"{folder}: is no folder; pass the output folder of g3r-infer")
        record = RunRecord.read(folder / "run.json")
        if record.registration is None:
            raise InputError(f"{folder / 'run.json'}: is a configuration, of no run; pass the output folder of a run")
        geometry = ReuseRecord.load(folder / REUSE_NAME)
        if len(geometry.stacks) != len(record.stacks):
            raise InputError(
                f"{folder / REUSE_NAME}: is of {len(geometry.stacks)} stacks, run.json of {len(record.stacks)}; "
                "pass a folder whose files belong together"
            )
        return cls(folder, record, geometry)

    @property
    def registration(self) -> RegistrationRecord:
        """The record of the registration."""
        assert self.record.registration is not None, "checked on reading"
        return self.record.registration

    @property
    def space(self) -> Space:
        """Space of the poses and the volume."""
        return self.registration.space

    @property
    def standard_from_scanner(self) -> RigidPose | None:
        """The rigid motion of points (RAS, mm) from the scanner to the volume; None if that is in scanner space."""
        matrix = self.registration.standard_from_scanner
        return None if matrix is None else RigidPose.from_matrix([matrix])

    @property
    def stack_names(self) -> list[str]:
        """Names of its input files."""
        return [stack.name for stack in self.record.stacks]

    @cached_property
    def cloud(self) -> GaussianCloud:
        """The Gaussians, in intensities of the fit.

        Raises:
            InputError: the file is missing or damaged.
        """
        return GaussianCloud.load(self.folder / "gaussians.npz")

    @cached_property
    def mixture(self) -> Mixture:
        """The mixture that makes the volume from the Gaussians.

        Raises:
            InputError: prior or density are missing, damaged or on another grid.
        """
        found = self.geometry
        prior, density = (self._map(name, found.prior_grid) for name in ("prior", "density"))
        settings = self.record.settings
        return Mixture(
            grid=found.grid,
            support=found.support,
            prior=prior.data / np.float32(found.intensity_scale),
            density=density.data,
            prior_grid=found.prior_grid,
            least_weight=self.record.prior_weight,
            edge=found.edge,
            cutoff_sigma=settings.slice_stage.cutoff_sigma,
            correction=found.correction,
        )

    def _map(self, name: str, grid: VolumeGrid) -> Volume:
        path = self.folder / f"{name}.nii.gz"
        found = load_volume(path)
        if found.data.shape != grid.shape:
            raise InputError(
                f"{path}: has {found.data.shape} voxels, {REUSE_NAME} expects {grid.shape}; pass a folder whose files "
                "belong together"
            )
        return found
