"""run.json as a record: all that is needed to assess a result and to run it again; file names only, no paths."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from g3r._version import __version__
from g3r.acquisition.images import Space
from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.fitting.held_out_slices import HeldOutChoice
from g3r.fitting.pose_rounds import PoseRounds
from g3r.fitting.volume_check import VolumeCheck
from g3r.fitting.voxel_correction import VoxelCorrectionRecord
from g3r.output.stack_record import StackRecord, mean_motion
from g3r.planning.memory_limit import MemoryRecord
from g3r.planning.plan import BudgetRecord
from g3r.planning.presets import ReconstructionSettings
from g3r.registration import Registration
from g3r.registration.open_strain import crossing_deg
from g3r.registration.quality import registration_reliable, registration_summary
from g3r.registration.stack_quality import StackQuality
from g3r.run.context import StoppedAt
from g3r.run.json_record import from_plain, to_plain
from g3r.run.provenance import FileHash
from g3r.uncertainty.unseen import UnseenPart

MAX_RECORD_BYTES = 50_000_000

LOSS_ROSE = "the loss of the fit rose"
"""Start of the warning about rollbacks; the verdict has a message of its own for them."""


@dataclass(frozen=True, kw_only=True)
class RegistrationRecord:
    """Record of the registration.

    Attributes:
        reliable: whether all stacks are registered; None for a single stack, which nothing checks.
        summary: one line on all stacks.
        initialisation: where the search started.
        held_out_correlation: held-out correlation of each stack, by initialisation.
        space: "standard" or "scanner".
        correlation_with_template: correlation of the head with the atlas template; None in scanner space.
        correlation_of_rival: the same for the best of all other orientations; None if none comes near, in scanner
            space, and with several stacks.
        orientation_doubtful: whether the rival is about as high (`MIN_RIVAL_MARGIN` in `registration/thresholds.py`).
        standard_from_scanner: [4, 4] rigid motion (RAS, mm) of points. Each slice has a motion of its own, so this is
            their robust mean, close to the stacks that agree with each other. None in scanner space.
        rounds: figures of each round.
        crossing_deg: the largest angle between slices of two stacks in the head; None for a single stack.
    """

    reliable: bool | None
    summary: str
    initialisation: str
    held_out_correlation: dict[str, list[float]]
    space: Space
    correlation_with_template: float | None
    standard_from_scanner: list[list[float]] | None
    rounds: list[dict[str, float]]
    correlation_of_rival: float | None = None
    orientation_doubtful: bool = False
    crossing_deg: float | None = None

    @classmethod
    def of(cls, registration: Registration, qualities: Sequence[StackQuality], slices: Slices) -> RegistrationRecord:
        """The record of a registration.

        Args:
            registration: registration of all stacks.
            qualities: one per stack.
            slices: slices in their final poses.
        """
        orientation = registration.orientation
        return cls(
            reliable=registration_reliable(qualities),
            summary=registration_summary(qualities),
            initialisation=registration.initialisation,
            held_out_correlation=registration.initialisations,
            space="scanner" if orientation is None else "standard",
            correlation_with_template=None if orientation is None else orientation.correlation,
            standard_from_scanner=None if orientation is None else mean_motion(slices),
            rounds=registration.history,
            correlation_of_rival=None if orientation is None else orientation.rival,
            orientation_doubtful=orientation is not None and orientation.is_doubtful,
            crossing_deg=crossing_deg(registration.slices),
        )


@dataclass(frozen=True)
class InactiveTerm:
    """A term of the model that is absent, and why."""

    term: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class CommandRecord:
    """Arguments of `g3r-infer`."""

    stacks: list[str]
    preset: str | None
    seed: int
    threads: int
    space: str
    device: str = "cpu"


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The input files of a result.

    Attributes:
        stacks: one per stack.
        masks: one per stack: the file, or the source of the mask and the hash of its voxels.
        prior, pose_network, mask_network: files of the networks; None if not used.
    """

    stacks: tuple[FileHash, ...]
    masks: tuple[FileHash, ...] = ()
    prior: FileHash | None = None
    pose_network: FileHash | None = None
    mask_network: FileHash | None = None

    def named(self) -> dict[str, FileHash]:
        """All files, by their role."""
        files = {f"stack {n + 1}": file for n, file in enumerate(self.stacks)}
        files |= {f"mask {n + 1}": file for n, file in enumerate(self.masks)}
        networks = {"prior": self.prior, "pose network": self.pose_network, "mask network": self.mask_network}
        return files | {name: file for name, file in networks.items() if file}

    def differences(self, now: Inputs) -> list[str]:
        """A sentence for each file of `now` with other bytes, and for each file that is not used any more."""
        then, found = self.named(), now.named()
        lines = [
            f"{name} ({file.name}) is not the file that the configuration's result was made of"
            for name, file in found.items()
            if name not in then or then[name].sha256 != file.sha256
        ]
        return lines + [f"{name} ({then[name].name}) is not used now" for name in then if name not in found]


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that determine the numbers."""
    return {"python": platform.python_version()} | {name: version(name) for name in ("torch", "numpy", "numba")}


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """run.json.

    Attributes:
        settings: as used.
        inputs, command, memory, header_text: added by the command; None from Python.
        prior, pose_network: the networks' own records; None if not used.
        registration: None if the file is only a configuration.
        stack_fields: coefficients of each stack's bias field, divided out before the fit; empty for one or two stacks.
        bias_field: coefficients that the fit added; empty if not estimated.
        common_bias_rms: RMS over the brain of the logarithm of the common bias field; 0 without estimate.
        pose_rounds: record of the rounds of poses and volume; None without rounds.
        held_out: choices made by held-out slices; None if there were none.
        prior_weight: least weight of V_prior in the volume.
        volume_check: how well volume, V_prior and V_coarse explain the slices; None without V_prior.
        voxel_correction: record of the correction on voxels; None without one.
        edge_by_image: whether the volume ends where slices become black beside the brain, not by their masks alone.
        gaussian_spacing_mm: spacing of the lattice of Gaussians; None if the run was interrupted before them.
        n_rollbacks: times that the fit to the slices went back to its best state.
        loss: figures of each step, by stage.
        unseen: the part of the brain that no slice saw.
        uncertainty: what `uncertainty.nii.gz` means; None if the run was interrupted.
        verdict, reasons: of the report: whether the volume may be used, and why; None without a report.
        resumed: stages taken from an earlier run.
        partial: whether the run was interrupted, at `stopped_at`.
    """

    g3r: str = __version__
    verdict: str | None = None
    reasons: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=versions)
    settings: ReconstructionSettings
    inputs: Inputs | None = None
    command: CommandRecord | None = None
    time_budget: BudgetRecord | None = None
    memory: MemoryRecord | None = None
    prior: dict[str, Any] | None = None
    pose_network: dict[str, Any] | None = None
    stacks: list[StackRecord]
    registration: RegistrationRecord | None = None
    stack_fields: list[list[float]] = field(default_factory=list)
    bias_field: list[list[float]] = field(default_factory=list)
    common_bias_rms: float = 0.0
    n_gaussians: int = 0
    pose_rounds: PoseRounds | None = None
    held_out: HeldOutChoice | None = None
    prior_weight: float = 0.0
    volume_check: VolumeCheck | None = None
    voxel_correction: VoxelCorrectionRecord | None = None
    edge_by_image: bool = False
    gaussian_spacing_mm: float | None = None
    n_rollbacks: int = 0
    inactive_terms: list[InactiveTerm] = field(default_factory=list)
    loss: dict[str, list[Any]] = field(default_factory=dict)
    unseen: UnseenPart | None = None
    uncertainty: dict[str, Any] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    resumed: list[str] = field(default_factory=list)
    partial: bool = False
    stopped_at: StoppedAt | None = None
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    header_text: list[dict[str, Any]] | None = None

    def differences(self, inputs: Inputs) -> list[str]:
        """A sentence for each input with other bytes, and for another version of g3r."""
        lines = self.inputs.differences(inputs) if self.inputs else []
        if self.g3r != __version__:
            lines.append(f"g3r is {__version__}, the configuration is of {self.g3r}")
        return [f"{line}: the volume will be another" for line in lines]

    def to_json(self) -> str:
        """The text of run.json."""
        return json.dumps(to_plain(self), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> RunRecord:
        """The record in the text of a run.json.

        Raises:
            ValueError: it is not JSON, or not a record of this version.
        """
        try:
            return from_plain(cls, json.loads(text), "run")
        except RecursionError:
            raise ValueError("nested too deeply") from None

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> RunRecord:
        """Read a run.json.

        Raises:
            InputError: it is not such a file, or of a version with other settings.
        """
        path = Path(path)
        try:
            if path.stat().st_size > MAX_RECORD_BYTES:
                raise InputError(f"{path}: is too large for a run.json; pass one that g3r-infer wrote")
            return cls.from_json(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); pass a run.json") from None
        except (json.JSONDecodeError, UnicodeDecodeError):
            raise InputError(f"{path}: is not JSON; pass a run.json that g3r-infer wrote") from None
        except (ValueError, TypeError) as error:
            raise InputError(
                f"{path}: is not a run.json of this version of g3r ({error}); pass one that g3r-infer wrote"
            ) from None


def inactive_terms(slices: Slices, settings: ReconstructionSettings) -> list[InactiveTerm]:
    """The inactive terms of the model, each with its reason: undetermined by the data, or switched off.

    Args:
        slices: the fitted slices.
        settings: as used for these slices.
    """
    stage, found = settings.slice_stage, []
    single = len(np.unique(slices.stack_id)) == 1
    if len(slices) == 1:
        found.append(InactiveTerm("gain of the slice", "a single slice: amplitudes explain its gain as well"))
    if single:
        found.append(InactiveTerm("bias field of each stack", "with a single stack it is the common one"))
    elif not stage.optimise_bias_field:
        found.append(InactiveTerm("bias field of each stack", "switched off in the settings"))
    if not settings.common_bias_field:
        found.append(InactiveTerm("common bias field", "switched off in the settings"))
    if not stage.optimise_poses:
        drifts = single and not (settings.use_prior and settings.distillation)
        reason = "a single stack without a prior to hold it drifts" if drifts else "switched off in the settings"
        found.append(InactiveTerm("poses in the fit", reason))
    if not settings.use_prior:
        found.append(InactiveTerm("distance to the prior", "no prior is in use"))
    elif not settings.distillation:
        off, worse = "distillation is switched off", "several stacks are nearer to the truth without it"
        reason = off if single else worse
        found.append(InactiveTerm("distance to the prior", reason))
    return found
