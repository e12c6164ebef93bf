"""--time-budget: the chosen settings, and a valid volume however short the time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.stacks import Stack, load_stack
from g3r.geometry.grid import on_grid
from g3r.planning import time_budget
from g3r.planning.anatomy import GENERIC
from g3r.planning.presets import PRESETS, ReconstructionSettings, for_anatomy, keeping_poses
from g3r.planning.time_budget import REGISTRATION_FROM_S, TimeBudget, fit_seconds
from g3r.reconstruct import GaussianReconstructor
from g3r.registration import Registration, RegistrationSettings
from g3r.report.verdict import verdict_of
from g3r.run.deadline import Deadline
from tests.quick import QUICK_FIT

SETTINGS = replace(QUICK_FIT, resolution_mm=1.5, use_prior=False)


class Clock:
    """A clock that stands still unless the test moves it."""

    now = 50.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def stacks(subject: Path) -> list[Stack]:
    return [load_stack(subject / f"stack-{n}.nii.gz", subject / f"mask-{n}.nii.gz", 4.0) for n in range(3)]


def budget(seconds: float, settings: ReconstructionSettings = SETTINGS) -> TimeBudget:
    return TimeBudget(settings=settings, deadline=Deadline.after(seconds, Clock()), given_s=seconds)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_is_a_positive_number(seconds: float) -> None:
    with pytest.raises(ValueError, match="expected a positive number"):
        TimeBudget.of(SETTINGS, seconds)


def test_what_was_spent_before_counts() -> None:
    assert 6.5 < TimeBudget.of(SETTINGS, 10.0, spent_s=3.0).deadline.remaining_s <= 7.0


@pytest.mark.parametrize(("late_s", "missed"), [(-1.0, False), (2.9, False), (3.1, True)])
def test_a_tenth_and_two_seconds_over_is_missed(late_s: float, missed: bool) -> None:
    clock = Clock()
    one = TimeBudget(settings=SETTINGS, deadline=Deadline.after(10.0, clock), given_s=10.0)
    clock.now += 10.0 + late_s
    assert one.missed is missed


def test_more_time_never_means_a_shorter_registration() -> None:
    order = list(REGISTRATION_FROM_S)
    chosen = []
    for seconds in (1, 10, 21, 22, 39, 40, 100, 120, 1000):
        one = budget(seconds)
        one.for_registration()
        chosen.append(order.index(one.choices["registration"]))
    assert chosen == sorted(chosen)
    assert chosen[0] == 0
    assert chosen[-1] == len(order) - 1


def test_registration_keeps_the_space_and_the_seed_that_were_asked_for() -> None:
    registration = replace(SETTINGS.registration, standard_orientation=False)
    one = budget(60.0, replace(SETTINGS, registration=registration, seed=7))
    deadline = one.for_registration()
    assert one.settings.registration.seed == 7
    assert not one.settings.registration.standard_orientation
    assert 0 < deadline.remaining_s < 60


def test_what_was_switched_off_stays_off() -> None:
    asked = replace(PRESETS["accurate"].registration, leave_out_misfits=False)
    one = budget(1000.0, replace(PRESETS["accurate"], registration=asked))
    one.for_registration()
    assert not one.settings.registration.leave_out_misfits
    assert one.settings.registration.check_handedness
    knee = budget(1000.0, for_anatomy(PRESETS["accurate"], GENERIC))
    knee.for_registration()
    assert not knee.settings.registration.template
    assert not knee.settings.registration.network


def test_poses_that_were_given_are_kept_whatever_time_there_is() -> None:
    one = budget(1000.0, keeping_poses(PRESETS["accurate"]))
    one.for_registration()
    one.for_prior(1.0)
    assert [one.settings.pose_rounds.n_rounds(n) for n in (1, 2, 3)] == [0, 0, 0]
    free = budget(1000.0, PRESETS["accurate"])
    free.for_registration()
    free.for_prior(1.0)
    assert free.settings.pose_rounds.n_rounds(2) > 0


def test_the_correction_on_voxels_is_that_of_the_fit_that_is_made() -> None:
    for name in ("fast", "balanced", "accurate"):
        one = budget(1000.0, PRESETS["accurate"])
        one._take(name, 1, 0.0)
        assert one.settings.voxel_correction == PRESETS[name].voxel_correction


def test_slices_are_searched_for_as_the_budget_chose(stacks: list[Stack], monkeypatch: pytest.MonkeyPatch) -> None:
    class Searched(Exception):
        """Raised where the search would begin, to end the run."""

    def register(slices: Slices, settings: RegistrationSettings, *_: Any) -> Registration:
        raise Searched(settings)

    reconstructor, plan = GaussianReconstructor(settings=SETTINGS), TimeBudget.of(SETTINGS, 5.0)
    monkeypatch.setattr(reconstructor, "register", register)
    with pytest.raises(Searched) as searched:
        reconstructor.reconstruct(stacks, plan=plan)
    preview = replace(PRESETS["preview"].registration, seed=SETTINGS.registration.seed)
    assert searched.value.args == (preview,)
    assert preview != SETTINGS.registration


def test_views_of_the_prior_follow_the_time_and_stay_within_what_there_is() -> None:
    budgets = [budget(seconds, QUICK_FIT) for seconds in (0.1, 10, 20, 40, 1e4)]
    for one in budgets:
        one.for_prior(1.0)
    views = [one.settings.prior_views for one in budgets]
    assert views == sorted(views)
    assert views[:2] == [0, 1]
    assert views[-1] == PRESETS["accurate"].prior_views


def test_presets_cost_more_one_after_the_other() -> None:
    presets = [preset for preset in PRESETS.values() if preset.n_lattices]
    numbers = [(2.5 / preset.gaussian_spacing_pixels) ** 3 for preset in presets]
    seconds = [fit_seconds(preset, 0.05, n) for preset, n in zip(presets, numbers, strict=True)]
    assert seconds == sorted(seconds)


def test_no_time_at_all_still_gives_a_volume_and_says_what_was_done(stacks: list[Stack]) -> None:
    result = GaussianReconstructor(settings=SETTINGS).reconstruct(stacks, plan=TimeBudget.of(SETTINGS, 0.01))
    assert np.isfinite(result.volume).all()
    assert result.volume[result.mask].mean() > 0
    record = result.record.time_budget
    assert record is not None
    assert record.seconds == 0.01
    assert (record.registration, record.fit, record.prior_views) == ("preview", "none", 0)
    assert result.record.loss["fit to slices"] == []
    assert result.uncertainty is None
    assert "no time for a fit" in verdict_of(result.record).line()


def test_a_network_that_had_no_time_is_not_said_to_be_used(stacks: list[Stack]) -> None:
    settings = replace(SETTINGS, use_prior=True)
    result = GaussianReconstructor(settings=settings).reconstruct(stacks, plan=TimeBudget.of(settings, 0.01))
    assert not result.record.settings.use_prior
    assert result.record.prior is None


@pytest.mark.parametrize("use_prior", [False, True])
def test_without_a_fit_the_prior_volume_is_shown_and_nothing_is_said_of_its_errors(
    stacks: list[Stack], use_prior: bool
) -> None:
    settings = replace(SETTINGS, use_prior=use_prior, n_lattices=0)
    result = GaussianReconstructor(settings=settings).reconstruct(stacks)
    assert result.record.n_gaussians == 0
    assert result.uncertainty is None
    assert result.prior_share is None
    assert verdict_of(result.record).word == "check"
    prior = on_grid(result.prior, result.prior_grid, result.grid, outside=0.0)
    inside = result.mask & (result.volume != 0)
    assert inside.sum() > 0.95 * result.mask.sum()
    np.testing.assert_allclose(result.volume[inside], prior[inside], rtol=1e-5)


def test_the_less_time_the_less_is_done_after_registration() -> None:
    done, by_least_squares = [], []
    for seconds in (0.5, 2.0, 3.5, 5.0):
        one = budget(seconds, PRESETS["balanced"])
        one.for_prior(1.0)
        done.append(one.settings.use_prior)
        by_least_squares.append(one.settings.least_squares_voxel_mm)
    assert done == [False, False, True, True]
    preview_mm = PRESETS["preview"].least_squares_voxel_mm
    assert by_least_squares == [preview_mm, preview_mm, 0.0, 0.0]


@pytest.mark.parametrize(("compiling", "fit", "rounds"), [(False, "fast", 2), (True, "none", 0)])
def test_the_seconds_of_compiling_count(
    compiling: bool, fit: str, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_budget, "needs_compiling", lambda room: compiling)
    shape = SimpleNamespace(volumes=None, values=np.zeros(8))
    one = budget(10.0, PRESETS["balanced"])
    one.for_fit_to_prior(shape, coarse_s=2.0, n_output_voxels=8)  # type: ignore[arg-type]
    assert one.choices["fit"] == fit
    another = budget(100.0, PRESETS["balanced"])
    another.for_prior(coarse_s=1.0)
    assert another.choices["pose_rounds"] == rounds


def test_with_time_enough_every_step_is_made(stacks: list[Stack]) -> None:
    """The registration is given, to keep the test quick."""
    reconstructor = GaussianReconstructor(settings=SETTINGS)
    registration = reconstructor.register_stacks(stacks)
    result = reconstructor.reconstruct(stacks, registration, plan=TimeBudget.of(SETTINGS, 600.0))
    assert result.record.time_budget is not None
    assert result.record.time_budget.fit == "accurate"
    assert len(result.record.loss["fit to slices"]) == PRESETS["accurate"].slice_stage.n_steps
    accurate = PRESETS["accurate"]
    assert result.record.settings.gaussian_spacing_pixels == accurate.gaussian_spacing_pixels
    assert len(result.record.loss["fit to prior"]) == accurate.prior_stage.n_steps
