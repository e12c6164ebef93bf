"""Steps on parts of the slices: choice of the parts, their loss and gradient."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from g3r.fitting.divergence_guard import DivergenceGuard
from g3r.fitting.objective import ImageTerm
from g3r.fitting.parameters import FitParameters
from g3r.fitting.slice_parameters import slice_blocks
from g3r.fitting.slice_stage import SliceLoss, SliceStageSettings
from g3r.fitting.slice_turns import FEWEST_SLICES, SliceTurns, slice_parts
from tests.fitting.scene import fit, make_slices, seeded, true_volume

SETTINGS = SliceStageSettings(optimise_bias_field=False, scale_weight=0.0, pose_prior_mm=1e6)


@pytest.fixture(scope="module")
def volume() -> np.ndarray:
    return true_volume()


def loss_of(volume: np.ndarray, n_parts: int, slice_weight: np.ndarray) -> SliceLoss:
    slices, ones = make_slices(), np.ones(24)
    blocks = slice_blocks(slices, ones, None, SETTINGS.rates, optimise_poses=True)
    return SliceLoss(
        FitParameters(seeded(volume), SETTINGS.rates, blocks),
        slices,
        gain=ones,
        slice_weight=slice_weight,
        bias_field=None,
        prior=None,
        settings=replace(SETTINGS, n_parts=n_parts),
    )


@pytest.mark.parametrize("n_parts", [1, 2, 3, 5])
def test_every_slice_comes_once_in_a_cycle_and_neighbours_in_different_parts(n_parts: int) -> None:
    stack_id = np.repeat([2, 0, 5], [9, 14, 8])
    parts = slice_parts(stack_id, n_parts)
    assert len(parts) == n_parts
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(31))
    assert np.ptp([len(part) for part in parts]) <= 1
    for stack in (0, 2, 5):
        mine = np.flatnonzero(stack_id == stack)
        for part in parts:
            np.testing.assert_array_equal(np.diff(part[np.isin(part, mine)]), n_parts)


@pytest.mark.parametrize("n_slices", [1, 2, FEWEST_SLICES, 2 * FEWEST_SLICES - 1])
def test_few_slices_are_not_split(n_slices: int) -> None:
    assert len(slice_parts(np.zeros(n_slices, int), 2)) == 1


@pytest.mark.parametrize("n_parts", [2, 3])
def test_the_parts_weighted_by_their_pixels_add_up_to_the_gradient_of_all(volume: np.ndarray, n_parts: int) -> None:
    slice_weight = np.random.default_rng(0).uniform(0.2, 1, 24)
    whole, parts = loss_of(volume, 1, slice_weight), loss_of(volume, n_parts, slice_weight)
    value, _ = whole.evaluate(0.5)
    shared = ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude", "rotation", "translation")
    expected = {name: whole.unknowns.parameters.gradient[name].astype(float) for name in shared}
    found = {name: np.zeros_like(gradient) for name, gradient in expected.items()}
    for part in parts.turns.parts:
        parts.evaluate(0.5)
        gradient = parts.unknowns.parameters.gradient
        share = whole.term.scale(slice_weight, part) / whole.term.scale(slice_weight)
        for name in shared:
            found[name] += share * gradient[name]
        unseen = np.setdiff1d(np.arange(24), part)
        assert (np.abs(gradient["log_gain"][part]) > 0).all()
        assert (gradient["log_gain"][unseen] == 0).all()
        assert np.abs(gradient["translation"][unseen]).max() < 1e-9 * np.abs(gradient["translation"]).max()
    for name in shared:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-4, atol=1e-5 * np.abs(expected[name]).max())
    assert parts.turns.is_complete
    assert parts.turns.mean(slice_weight) == pytest.approx(value, rel=1e-6)


def test_the_loss_between_steps_is_that_of_all_slices_seen(volume: np.ndarray) -> None:
    """Parts that fit differently do not count as a rise of the loss; weights change once all slices were seen."""
    weight = np.ones(24)
    loss = loss_of(volume, 2, weight)
    loss.evaluate(0.0)
    assert not loss.turns.is_complete
    assert loss.reweight() == 1.0
    np.testing.assert_array_equal(loss.slice_weight, weight)
    values = [loss.evaluate(0.0)[0] for _ in range(4)]
    np.testing.assert_allclose(values, values[0], rtol=1e-9)
    loss.turns.forget()
    assert not loss.turns.is_complete


def test_overlap_lists_are_not_made_again_for_each_part(volume: np.ndarray) -> None:
    loss = loss_of(volume, 2, np.ones(24))
    for _ in range(6):
        loss.evaluate(0.0)
    assert loss.objective.n_searches == 1


def test_a_fit_by_halves_sees_all_slices_and_ends_near_that_of_whole_steps(volume: np.ndarray) -> None:
    log_gain = np.random.default_rng(1).normal(0, 0.08, 24)
    slices = make_slices(np.exp(log_gain - log_gain.mean()))
    options: dict[str, Any] = {"optimise_poses": False}
    halves = fit(0.8 * volume + 0.1, slices, n_steps=80, n_parts=2, **options)
    whole = fit(0.8 * volume + 0.1, slices, n_steps=40, n_parts=1, **options)
    assert halves.history[-1]["image"] < 1.1 * whole.history[-1]["image"]
    assert (halves.gain != 1).all()


def test_turns_go_round() -> None:
    slices = make_slices()
    term = ImageTerm.of(slices.planes, slices.value, slices.mask.astype(np.float32))
    turns = SliceTurns(term, slices.stack_id, 3)
    seen = [turns.next() for _ in range(6)]
    for first, second in zip(seen[:3], seen[3:], strict=True):
        np.testing.assert_array_equal(first, second)


def test_a_rollback_forgets_what_later_states_gave(volume: np.ndarray) -> None:
    loss = loss_of(volume, 2, np.ones(24))
    parameters = loss.unknowns.parameters
    guard = DivergenceGuard(parameters, loss.level)
    for _ in range(2):
        assert guard.step(loss.evaluate(0.0)[0], 1.0)
    parameters.value["amplitude"][...] = np.nan
    assert not guard.step(loss.evaluate(0.0)[0], 1.0)
    loss.turns.forget()
    assert np.isfinite(loss.evaluate(0.0)[0])
