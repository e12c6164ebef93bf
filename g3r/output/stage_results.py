"""What the stages of a run hand to its result."""

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
        stacks: as they were given.
        registration: poses of their slices, intensities as they were matched.
        stack_fields: coefficients of the fields that matching divided out.
        prior: the prior volume and what it was made of.
        intensity: intensity of 1 in the fit.
        rounds: what rounds of poses and volume did; None where there was none.
        held_out: what held-out slices chose; None where they were not asked.
        cloud: of the fit to the prior; None where the run was stopped before its end: its Gaussians show the prior
            volume less well than that volume does.
        fit: of the fit to the slices; None before it.
        prior_record, pose_record: the networks' own; None where one is not used.
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
        """The slices as registration left them, and no Gaussians."""
        cloud = GaussianCloud.empty()
        slices, gain, weight = self.prior.volumes.slices, self.prior.gain, self.registration.weight
        return SliceFit(cloud=cloud, slices=slices, gain=gain, weight=weight, history=[], bias_field=[])
