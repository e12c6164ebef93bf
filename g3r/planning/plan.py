"""The plan of a run: its settings, and when its loops have to end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from g3r.fitting.initial_volumes import PriorVolume
from g3r.planning.presets import ReconstructionSettings
from g3r.run.deadline import Deadline, LoopRecord


@dataclass(frozen=True, kw_only=True)
class BudgetRecord:
    """Choices of a time budget; None for a choice that the run did not reach.

    Attributes:
        seconds: of the budget.
        registration, fit: names of the presets that registration and the fit follow; "none" without a fit.
        prior_views: views of the prior; 0 where there was no time for its network.
        pose_rounds: most rounds of poses and volume.
        step_s: measured seconds of one optimiser step.
        n_gaussians_timed: Gaussians in that step.
        reserve_s: seconds kept for what follows the fit.
        left_s: seconds for the fit.
        loops: for each loop of the run, in order, the fraction of its schedule at each step.
    """

    seconds: float
    registration: str | None = None
    prior_views: int | None = None
    pose_rounds: int | None = None
    fit: str | None = None
    step_s: float | None = None
    n_gaussians_timed: int | None = None
    reserve_s: float | None = None
    left_s: float | None = None
    loops: list[list[float]] = field(default_factory=list)


class Plan(Protocol):
    """The settings of a run, and when its loops have to end."""

    settings: ReconstructionSettings

    def for_registration(self) -> Deadline | None:
        """Decide how registration searches; returns when it has to end."""

    def for_prior(self, coarse_s: float) -> None:
        """Decide on prior, its views and rounds of poses; `coarse_s` is what V_coarse and V_sharp took."""

    def for_fit_to_prior(self, prior: PriorVolume, coarse_s: float, n_output_voxels: int) -> Deadline | None:
        """Decide Gaussians and steps of both stages of the fit.

        Args:
            prior: V_prior and the posed slices that it was made of.
            coarse_s: seconds that V_coarse and V_sharp took.
            n_output_voxels: voxels of the volume to be written.

        Returns:
            Deadline of the first stage; None for no deadline.
        """

    def for_fit_to_slices(self) -> Deadline | None:
        """When the second stage of the fit has to end."""

    def record(self) -> BudgetRecord | None:
        """The decisions; None where there were none."""


@dataclass
class FixedPlan:
    """Settings that hold to the end, and no deadline."""

    settings: ReconstructionSettings

    def for_registration(self) -> Deadline | None:
        """No deadline."""
        return None

    def for_prior(self, coarse_s: float) -> None:
        """Nothing to decide."""

    def for_fit_to_prior(self, prior: PriorVolume, coarse_s: float, n_output_voxels: int) -> Deadline | None:
        """No deadline.

        Args: see `Plan`.
        """
        return None

    def for_fit_to_slices(self) -> Deadline | None:
        """No deadline."""
        return None

    def record(self) -> BudgetRecord | None:
        """Nothing was decided."""
        return None


class RepeatedBudget(FixedPlan):
    """A repeat of a run with a time budget, without a clock: settings are known, and loops take the recorded steps.

    Args:
        settings: of the earlier run.
        earlier: its record.
    """

    def __init__(self, settings: ReconstructionSettings, earlier: BudgetRecord) -> None:
        super().__init__(settings)
        self.earlier = earlier
        self.deadline = Deadline(loop_record=LoopRecord(earlier.loops, repeating=True))

    def for_registration(self) -> Deadline:
        """Repeat the loops."""
        return self.deadline

    def for_fit_to_prior(self, prior: PriorVolume, coarse_s: float, n_output_voxels: int) -> Deadline:
        """Repeat the loops.

        Args: see `Plan`.
        """
        return self.deadline

    def for_fit_to_slices(self) -> Deadline:
        """Repeat the loops."""
        return self.deadline

    def record(self) -> BudgetRecord:
        """The decisions of the earlier run."""
        return self.earlier
