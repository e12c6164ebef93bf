"""Rounds of poses and volume bring slices closer to the truth, and are undone if stacks predict each other worse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.fitting import pose_rounds
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.pose_rounds import PoseRoundSettings, RefinedPoses, RoundFit, refine_in_rounds
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.fitting.prior_volume import prior_volume
from g3r.fitting.slice_stage import SliceStageSettings
from g3r.fitting.slice_targets import SliceModel
from g3r.gaussians.seeding import LatticeSpacing
from g3r.geometry import RigidPose
from g3r.planning.presets import PRESETS, adapted
from g3r.prior.maps import DEFAULT_TILING
from g3r.registration import Registration
from g3r.registration.held_out import fine_held_out_correlations
from tests.fitting.scene import make_slices
from tests.registration.moving_heads import with_jerk

ERROR_MM = 0.6
"""Standard deviation per axis of the initial displacement of slices."""


def registration_of(slices: Slices) -> Registration:
    n = len(slices)
    return Registration(
        slices=slices,
        gain=np.ones(n),
        weight=np.ones(n),
        ncc=np.ones(n),
        held_out=[0.9, 0.9, 0.9],
        initialisation="headers",
        initialisations={},
        interleave=[None] * 3,
        n_segments=[1] * 3,
        median_move_mm=[0.0] * 3,
        orientation=None,
    )


def moved_away(slices: Slices) -> Slices:
    rng = np.random.default_rng(1)
    shift = RigidPose(np.tile(np.eye(3), (len(slices), 1, 1)), rng.normal(0, ERROR_MM, (len(slices), 3)))
    return slices.with_pose(shift @ slices.planes.pose)


class PriorMaker:
    """A prior maker that returns V_sharp of the slices, and records its calls."""

    def __init__(self) -> None:
        self.last: list[bool] = []

    def __call__(self, poses: Registration, last: bool) -> PriorVolume:
        self.last.append(last)
        volumes = InitialVolumes.of(poses.slices, poses.gain, poses.weight, 1.0, common_bias_field=False)
        return prior_volume(volumes, poses.gain, poses.weight, None, None, n_views=1, tiling=DEFAULT_TILING)


def run(start: Registration, n_rounds: int) -> tuple[RefinedPoses, PriorMaker]:
    maker = PriorMaker()
    found = refine_in_rounds(
        start,
        maker(start, False),
        n_rounds,
        prior_of=maker,
        fit=RoundFit(
            settings=PoseRoundSettings(prior_steps=8, slice_steps=30),
            lattice=LatticeSpacing(pixels=2.2, at_most_mm=10.0),
            prior_stage=PriorStageSettings(),
            slice_stage=SliceStageSettings(prior_error=0.0),
            slice_model=SliceModel(surroundings=False),
            distillation=False,
        ),
        rng=np.random.default_rng(0),
    )
    maker.last.pop(0)
    return found, maker


def error_mm(slices: Slices, true: Slices) -> float:
    """Median distance of slices from their true places, after removal of their common shift."""
    away = slices.planes.center_mm - true.planes.center_mm
    return float(np.median(np.linalg.norm(away - away.mean(0), axis=1)))


def test_slices_come_nearer_to_the_truth_round_by_round() -> None:
    true = make_slices()
    start = registration_of(moved_away(true))
    found, maker = run(start, 2)
    assert found.record.n_kept == 2
    assert maker.last == [False, True]
    assert found.record.held_out == sorted(found.record.held_out)
    assert error_mm(found.registration.slices, true) < 0.5 * error_mm(start.slices, true)
    assert found.prior.volumes.slices.planes.center_mm == pytest.approx(found.registration.slices.planes.center_mm)


@pytest.mark.parametrize("n_stacks", [1, 3])
def test_slices_of_several_stacks_are_searched_for_where_they_do_not_fit(
    n_stacks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights: list[np.ndarray] = []

    def found_seven(
        slices: Slices, gain: np.ndarray, weight: np.ndarray, ncc: np.ndarray, rng: object
    ) -> tuple[Slices, int]:
        weights.append(weight)
        return slices, 7

    monkeypatch.setattr(pose_rounds, "find_strays", found_seven)
    true = make_slices()
    true = true.take(true.stack_id < n_stacks)
    middle = int(np.flatnonzero(true.stack_id == 0)[np.count_nonzero(true.stack_id == 0) // 2])
    start = registration_of(with_jerk(true, np.array([middle])))
    weight = np.ones(len(true))
    weight[middle] = 1e-3
    found, _ = run(replace(start, weight=weight), 1)
    assert len(weights) == (n_stacks > 1)
    assert (found.record.n_moved[0] >= 7) == (n_stacks > 1)
    assert all(one[middle] < 0.5 * np.median(one) for one in weights)


def held_outs(monkeypatch: pytest.MonkeyPatch, *values: float) -> None:
    """Let the held-out correlation have these values, before the first round and after each."""
    given = iter(values)
    monkeypatch.setattr(pose_rounds, "fine_held_out_correlations", lambda slices, gain: [next(given)])


def test_a_round_that_goes_astray_is_undone_and_ends_the_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    held_outs(monkeypatch, 0.9, 0.9 - 2 * pose_rounds.MAX_LOSS, 0.95)
    start = registration_of(moved_away(make_slices()))
    found, maker = run(start, 3)
    assert found.record.n_kept == 0
    assert len(found.record.held_out) == 2
    assert found.registration is start
    assert maker.last == [True]  # the first V_prior was made with the quick option


def test_rounds_do_not_lose_more_than_the_limit_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    held_outs(monkeypatch, *(0.9 - 0.7 * pose_rounds.MAX_LOSS * n for n in range(4)))
    found, _ = run(registration_of(moved_away(make_slices())), 3)
    assert found.record.n_kept == 1
    assert len(found.record.held_out) == 3


def test_each_round_leaves_no_more_of_an_open_shear_than_motion_is_likely_to_have(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken_out: list[Slices] = []

    def without(slices: Slices, interleave: list[int | None]) -> Slices:
        assert interleave == [None] * 3
        taken_out.append(slices.with_motion(slices.world_from_header()))
        return taken_out[-1]

    monkeypatch.setattr(pose_rounds, "without_excess_shear", without)
    found, _ = run(registration_of(moved_away(make_slices())), 1)
    assert found.record.n_kept == 1
    assert found.registration.slices is taken_out[0]


def test_rounds_follow_the_number_of_stacks_and_a_single_one_has_them_only_where_the_prior_holds_it() -> None:
    rounds = PoseRoundSettings(single_stack=1, two_stacks=2, more_stacks=3)
    assert [rounds.n_rounds(n) for n in (1, 2, 3, 12)] == [1, 2, 3, 3]
    assert rounds.at_most(1) == PoseRoundSettings(single_stack=1, two_stacks=1, more_stacks=1)
    settings = replace(PRESETS["balanced"], pose_rounds=rounds)
    for free in (replace(settings, use_prior=False), replace(settings, distillation=False)):
        assert adapted(free, 1).pose_rounds.n_rounds(1) == 0
        assert adapted(free, 2).pose_rounds.n_rounds(2) == 2
    assert adapted(settings, 1).pose_rounds.n_rounds(1) == 1


def test_the_fit_of_a_single_stack_alone_is_held_to_the_prior() -> None:
    settings = PRESETS["balanced"]
    assert [adapted(settings, n).distillation for n in (1, 2, 3)] == [True, False, False]
    assert adapted(replace(settings, several_stacks_distilled=True), 2).distillation
    assert not adapted(replace(settings, several_stacks_distilled=True, distillation=False), 2).distillation


def test_held_out_correlation_tells_poses_half_a_millimetre_apart() -> None:
    true = make_slices()
    ones = np.ones(len(true))
    right, wrong = (fine_held_out_correlations(slices, ones) for slices in (true, moved_away(true)))
    assert np.mean(right) > np.mean(wrong) + 0.01
    dark = np.where(true.stack_id == 1, 0.5, 1.0)
    darker = replace(true, value=(true.value * dark[true.planes.plane_id()]).astype(np.float32))
    assert fine_held_out_correlations(darker, dark) == pytest.approx(right, abs=1e-5)
