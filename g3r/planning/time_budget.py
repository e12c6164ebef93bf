"""Settings for a time budget: what fits into the seconds that are left, decided stage by stage by the clock.

Before registration only the budget is known, so it alone decides how registration searches; the loops of registration
end by the clock. After it the slices are in place, one optimiser step is timed, and the most careful preset whose steps
fit is taken. Every loop also has a deadline, so that a wrong estimate costs steps and not the promised time.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from g3r.acquisition.planes import Slices
from g3r.fitting.fit_context import FitContext
from g3r.fitting.initial_volumes import PriorVolume
from g3r.fitting.slice_stage import SliceStageSettings, fit_slices
from g3r.gaussians import GaussianCloud
from g3r.gaussians.seeding import seed_cloud
from g3r.planning.plan import BudgetRecord
from g3r.planning.presets import PRESETS, ReconstructionSettings
from g3r.run.deadline import Deadline, LoopRecord
from g3r.run.kernel_cache import COMPILING_FIT_S, needs_compiling

logger = logging.getLogger(__name__)

REGISTRATION_FROM_S = {"preview": 0.0, "fast": 18.0, "balanced": 36.0, "accurate": 120.0}
"""Budget from which on registration searches as in a preset: about the seconds of the whole command on two cores, from
one preset to the next."""

PRIOR_FROM_S = 13.0
"""Seconds left at the start from which on the prior network is used. The import of its libraries takes two of them, and
with fewer seconds in all there is often no time left for the network itself, on two cores and a 30-week head."""

SWITCHES = ("template", "network", "segments", "check_handedness", "leave_out_misfits")
"""Fields of `RegistrationSettings` that options and anatomy switch off; a budget never switches them on again."""

REGISTRATION_SHARE = 0.5
"""Largest share of the remaining time that registration may take."""

PRIOR_STAGE_SHARE = 0.35
"""Largest share of the time of both stages of the fit that the first may take."""

STEPS_ENOUGH = 0.7
"""Share of a preset's steps that must fit for it to be taken: too many Gaussians to fit are worse than fewer."""

COARSE_PER_VIEW = 1.2
"""Seconds of one view of the prior network over those of V_coarse and V_sharp on the same voxels."""

VIEWS_SHARE = 0.2
"""Largest share of the remaining time that views of the prior beyond the first may take."""

ROUND_OVER_COARSE = 4.0
"""Seconds of a round of poses and volume, without the views of the prior, over those of V_coarse and V_sharp."""

ROUNDS_SHARE = 0.3
"""Largest share of the remaining time that these rounds may take."""

COARSE_AT_END = 0.9
"""Seconds of the steps after the fit (volume, uncertainty, writing) over those of V_coarse and V_sharp, for an
output of as many voxels; the picture and the files take another `WRITING_S`."""

WRITING_S = 1.5

CORRECTION_OVER_COARSE, EDGE_OVER_COARSE = 1.7, 0.4
"""Seconds of the correction on voxels, and of the edge by the image, over those of V_coarse and V_sharp."""

VOLUME_AT_END = 0.15
"""`COARSE_AT_END` of a run without a fit, which has no maps of uncertainty."""

TOO_LITTLE, NO_FIT = 4.0, 2.2
"""Time left for the fit, over the seconds of V_coarse and V_sharp, below which no step is timed, or no fit is made."""

QUICKEST_FIT = "fast"
"""Preset whose fit is made if no other fits; the deadline ends it."""

SHARE_STEPS = 36
"""Number of optimiser steps that take as long as one probe of the prior share."""

PROBE_EVERY = 4
"""One in this many slices is rendered to time a step."""

COST_EXPONENT = 0.6
"""Exponent of the seconds of a step in the number of Gaussians of a head: smaller Gaussians have fewer pixels."""


@dataclass(kw_only=True)
class TimeBudget:
    """A plan whose settings follow the seconds that are left.

    Args:
        settings: what the budget does not decide; changed with each decision.
        deadline: when the files have to be written.
        given_s: seconds of the budget.
    """

    settings: ReconstructionSettings
    deadline: Deadline
    given_s: float
    choices: dict[str, Any] = field(default_factory=dict)
    fit_deadline: Deadline | None = None

    @classmethod
    def of(cls, settings: ReconstructionSettings, seconds: float, spent_s: float = 0.0) -> TimeBudget:
        """A budget of which some seconds were spent already.

        Args:
            settings: what the budget does not decide.
            seconds: of the whole command.
            spent_s: seconds of the budget before this call.

        Raises:
            ValueError: not a positive number.
        """
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(f"time budget {seconds}; expected a positive number of seconds")
        if seconds - spent_s < PRIOR_FROM_S:
            settings = _by_least_squares(settings)
        deadline = replace(Deadline.after(seconds - spent_s), loop_record=LoopRecord())
        return cls(settings=settings, deadline=deadline, given_s=seconds)

    @property
    def missed(self) -> bool:
        """Whether the run took more than a tenth and two seconds over the budget."""
        return self.deadline.remaining_s < -(0.1 * self.given_s + 2.0)

    def for_registration(self) -> Deadline:
        """Search as in the most careful preset that the budget allows."""
        left = self.deadline.remaining_s
        allowed = [name for name, min_s in REGISTRATION_FROM_S.items() if self.given_s >= min_s]
        name = max(allowed, key=lambda name: REGISTRATION_FROM_S[name])
        asked = self.settings.registration
        preset = PRESETS[name].registration
        # what was switched off stays off, whatever the budget allows
        switches = {one: getattr(preset, one) and getattr(asked, one) for one in SWITCHES}
        chosen = replace(preset, standard_orientation=asked.standard_orientation, **switches)
        self.settings = replace(self.settings, registration=chosen)
        self.choices["registration"] = name
        logger.info("time budget: %.0f s left, registration as in %s", left, name)
        return self.deadline.part(REGISTRATION_SHARE)

    def for_prior(self, coarse_s: float) -> None:
        """Take as many views of the prior and rounds of poses as fit, at most those of `accurate`, or no prior at all.

        Args:
            coarse_s: what V_coarse and V_sharp took.
        """
        view_s = COARSE_PER_VIEW * coarse_s
        views = int(VIEWS_SHARE * max(0.0, self.deadline.remaining_s) / view_s) if view_s > 0 else 1
        views = min(max(1, views), PRESETS["accurate"].prior_views)
        round_s = ROUND_OVER_COARSE * coarse_s + view_s * views + compiling_s()
        rounds = int(ROUNDS_SHARE * max(0.0, self.deadline.remaining_s) / round_s) if round_s > 0 else 0
        # without motion segments poses are kept as they were given
        careful = PRESETS["accurate"].pose_rounds if self.settings.registration.segments else self.settings.pose_rounds
        pose_rounds = replace(careful.at_most(rounds), moves_to_prior=min(max(1, rounds), careful.moves_to_prior))
        self.settings = replace(self.settings, prior_views=views, pose_rounds=pose_rounds)
        if not self.settings.use_prior:
            self.settings = replace(self.settings, prior_views=0)
        elif self.deadline.remaining_s < WRITING_S + VOLUME_AT_END * coarse_s + view_s:
            self.settings = _by_least_squares(self.settings)
        self.choices |= {"prior_views": self.settings.prior_views, "pose_rounds": pose_rounds.two_stacks}

    def for_fit_to_prior(self, prior: PriorVolume, coarse_s: float, n_output_voxels: int) -> Deadline:
        """Take the most careful preset whose Gaussians and steps fit, with the deadline of the first stage, or no fit.

        Args:
            prior: V_prior and the posed slices that it was made of.
            coarse_s: what making the volumes took.
            n_output_voxels: of the volume to be written.
        """
        settings, volumes = self.settings, prior.volumes
        at_end = (COARSE_AT_END + EDGE_OVER_COARSE) * max(1.0, n_output_voxels / prior.values.size)
        after_s = WRITING_S + at_end * coarse_s
        after_compiling_s = self.deadline.remaining_s - after_s - compiling_s()
        if after_compiling_s < NO_FIT * coarse_s:
            self.settings = replace(settings, n_lattices=0)
            self.choices |= {"fit": "none"}
            return self.deadline
        if after_compiling_s < TOO_LITTLE * coarse_s:
            # timing a step would take the time of the steps themselves
            reserve_s = after_s + (coarse_s if settings.use_prior else 0.0)
            self.choices |= {"fit": QUICKEST_FIT, "reserve_s": round(reserve_s, 2)}
            logger.info("time budget: %.0f s left for the fit and the files", self.deadline.remaining_s)
            return self._take(QUICKEST_FIT, PRESETS[QUICKEST_FIT].share_probes, reserve_s)
        if settings.voxel_correction is not None:
            after_s += CORRECTION_OVER_COARSE * coarse_s
        spacing_mm = {name: preset.lattice.mm(volumes.slices) for name, preset in PRESETS.items() if preset.n_lattices}
        cloud = seed_cloud(prior.values, prior.support, volumes.grid, spacing_mm["fast"])
        step_s = timed_step(cloud, volumes.slices, np.random.default_rng(settings.seed))
        for probes in (PRESETS["accurate"].share_probes, PRESETS[QUICKEST_FIT].share_probes):
            reserve_s = after_s + (SHARE_STEPS * step_s * probes if settings.use_prior else 0.0)
            left = max(0.0, self.deadline.remaining_s - reserve_s)
            number = {name: (spacing_mm["fast"] / mm) ** 3 for name, mm in spacing_mm.items()}
            needed_s = {name: STEPS_ENOUGH * fit_seconds(PRESETS[name], step_s, number[name]) for name in number}
            chosen = next((name for name in reversed(needed_s) if needed_s[name] <= left), QUICKEST_FIT)
            if needed_s[chosen] <= left:
                break
        self.choices |= {
            "fit": chosen,
            "step_s": round(step_s, 4),
            "n_gaussians_timed": len(cloud),
            "reserve_s": round(reserve_s, 2),
            "left_s": round(left, 2),
        }
        logger.info("time budget: %.0f s left for the fit, Gaussians as in %s", left, chosen)
        return self._take(chosen, probes, reserve_s)

    def for_fit_to_slices(self) -> Deadline:
        """When the second stage of the fit has to end; `for_fit_to_prior` comes first."""
        assert self.fit_deadline is not None
        return self.fit_deadline

    def _take(self, name: str, probes: int, reserve_s: float) -> Deadline:
        """Follow a preset in the fit; returns the deadline of its first stage."""
        preset, settings = PRESETS[name], self.settings
        self.settings = replace(
            settings,
            gaussian_spacing_pixels=preset.gaussian_spacing_pixels,
            max_gaussian_spacing_mm=preset.max_gaussian_spacing_mm,
            held_out=None,  # three fits whose time is not estimated
            n_lattices=PRESETS["accurate"].n_lattices,  # as many as there is time for
            share_probes=probes,
            voxel_correction=preset.voxel_correction if settings.voxel_correction else None,
            prior_stage=replace(preset.prior_stage, projection_bytes=settings.prior_stage.projection_bytes),
            slice_stage=replace(settings.slice_stage, n_steps=PRESETS["accurate"].slice_stage.n_steps),
        )
        self.fit_deadline = self.deadline.part(1.0, reserve_s)
        return self.fit_deadline.part(PRIOR_STAGE_SHARE)

    def record(self) -> BudgetRecord:
        """The decisions, for run.json."""
        loops = self.deadline.loop_record.loops if self.deadline.loop_record else []
        return BudgetRecord(seconds=self.given_s, loops=loops, **self.choices)


def _by_least_squares(settings: ReconstructionSettings) -> ReconstructionSettings:
    """The settings without the prior network, with the volume of `preview` in its place."""
    least_mm = PRESETS["preview"].least_squares_voxel_mm
    return replace(settings, use_prior=False, prior_views=0, least_squares_voxel_mm=least_mm)


def compiling_s() -> float:
    """Seconds that compiling adds to the first fit; 0 where its kernels are compiled."""
    return COMPILING_FIT_S if needs_compiling("gaussians") else 0.0


def fit_seconds(preset: ReconstructionSettings, step_s: float, number: float) -> float:
    """Seconds of both stages with the settings of a preset.

    Args:
        preset: whose steps.
        step_s: seconds of a step of the slice stage.
        number: its Gaussians over those that were timed.
    """
    step = step_s * number**COST_EXPONENT
    first, second = preset.prior_stage, preset.slice_stage
    in_first = PRIOR_STEP * (first.n_steps + first.amplitude_iterations)
    return step * (in_first + AMPLITUDE_STEP * second.amplitude_iterations + second.n_steps)


PRIOR_STEP, AMPLITUDE_STEP = 0.7, 1.5
"""Seconds of a step of stage 1, and of one conjugate-gradient step for the amplitudes, over a step of stage 2."""


def timed_step(cloud: GaussianCloud, slices: Slices, rng: np.random.Generator) -> float:
    """Time one step of the slice stage, in seconds, by a few steps on a subset of the slices.

    Args:
        cloud: to fit; left as it is.
        slices: all slices; the result is scaled to their number.
        rng: draws what the steps draw.
    """
    part = slices.take(np.arange(0, len(slices), min(PROBE_EVERY, max(1, len(slices) // 4))))
    ones = np.ones(len(part))
    seconds = []
    for n_steps in (1, 1, 4):  # the first loads the kernels; the last difference leaves out the set-up
        settings = SliceStageSettings(n_steps=n_steps, amplitude_iterations=0)
        start = time.perf_counter()
        fit_slices(cloud, part, gain=ones, weight=ones, prior=None, settings=settings, context=FitContext(rng=rng))
        seconds.append(time.perf_counter() - start)
    return max(1e-6, (seconds[-1] - seconds[-2]) / 3) * len(slices) / len(part)
