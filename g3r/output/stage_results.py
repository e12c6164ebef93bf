"""Results of the stages of a run, from which its result is assembled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from g3r.acquisition.stacks import Stack
from g3r.fitting.held_out_slices import HeldOutChoice
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.pose_rounds import PoseRounds
from g3r.fitting.prior_stage import PriorCloud
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import GaussianCloud
from g3r.registration import Registration


@dataclass(frozen=True, kw_only=True)
class StageResults:
    """Results of the stages of a run.

    Attributes:
        stacks: as given.
        registration: poses of their slices, with matched intensities.
        stack_fields: coefficients of the bias fields that intensity matching divided out.
        prior: the prior volume and the volumes it was made from.
        intensity: intensity in the stacks of a 1 in the fit.
        rounds: record of the rounds of poses and volume; None without rounds.
        held_out: choices made by held-out slices; None if there were none.
        cloud: result of the fit to the prior; None if the run was stopped before its end, because its Gaussians then
            show the prior volume less well than that volume itself does.
        fit: result of the fit to the slices; None before it.
        prior_record, pose_record: the networks' own records; None if not used.
    """

    stacks: Sequence[Stack]
    registration: Registration
    stack_fields: list[list[float]]
    prior: PriorVolume
    rounds: PoseRounds | None
    intensity: float
    cloud: PriorCloud | None
    held_out: HeldOutChoice | None
    fit: SliceFit | None
    prior_record: dict[str, Any] | None
    pose_record: dict[str, Any] | None

    def no_fit(self) -> SliceFit:
        """A stand-in for a fit: the slices as registration left them, and no Gaussians."""
        cloud = GaussianCloud.empty()
        slices, gain, weight = self.prior.volumes.slices, self.prior.gain, self.registration.weight
        return SliceFit(cloud=cloud, slices=slices, gain=gain, weight=weight, history=[], bias_field=[])
