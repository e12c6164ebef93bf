"""The cheapest sequence of motions in time: against brute force, and with planted jerks."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from g3r.acquisition.interleave import acquisition_order
from g3r.geometry import RigidPose
from g3r.registration.motion_segments import (
    CHANGE_PENALTY,
    HEAD_RADIUS_MM,
    best_segments,
    changes_in_time,
    cheapest_path,
    estimate_interleave,
    head_distance_mm,
    promising,
    time_orders,
    transition_penalty,
)
from g3r.registration.similarity import StackSamples
from tests.registration.moving_heads import as_slices, simulated

CENTER_MM = np.array([12.0, -7.0, 40.0])


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.integers(0, 10_000))
def test_the_cheapest_path_is_that_of_brute_force(n: int, n_states: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost, penalty = (rng.normal(size=(n, n_states)), rng.random((n_states, n_states)) * rng.choice([0.1, 1, 10]))
    path, total = cheapest_path(cost, penalty)

    def sum_of(states: tuple[int, ...]) -> float:
        changes = sum(penalty[a, b] for a, b in itertools.pairwise(states))
        return sum(cost[t, s] for t, s in enumerate(states)) + changes

    best = min(itertools.product(range(n_states), repeat=n), key=sum_of)
    assert total == pytest.approx(sum_of(best))
    assert tuple(path.tolist()) == best


def test_the_distance_is_that_of_a_ball() -> None:
    rng = np.random.default_rng(0)
    a = RigidPose(Rotation.random(3, rng=rng).as_matrix(), rng.normal(0, 20, (3, 3)))
    b = RigidPose(Rotation.random(2, rng=rng).as_matrix(), rng.normal(0, 20, (2, 3)))
    direction = rng.normal(size=(200_000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    ball = CENTER_MM + direction * HEAD_RADIUS_MM * rng.random((200_000, 1)) ** (1 / 3)
    found = head_distance_mm(a, b, CENTER_MM)
    for i, j in np.ndindex(3, 2):
        apart = a.take([i]).apply(ball[None])[0] - b.take([j]).apply(ball[None])[0]
        assert found[i, j] == pytest.approx(np.sqrt((apart**2).sum(1).mean()), rel=5e-3)
    np.testing.assert_allclose(np.diag(head_distance_mm(a, a, CENTER_MM)), 0, atol=1e-5)


def test_the_distance_does_not_depend_on_where_the_head_is() -> None:
    """A rotation about the head's own centre moves it by the rotation alone."""
    turn = Rotation.from_rotvec([0, 0, 0.4]).as_matrix()
    near, far = (
        head_distance_mm(RigidPose.identity(1), RigidPose(turn[None], (c - turn @ c)[None]), c)[0, 0]
        for c in (np.zeros(3), np.array([500.0, -300, 80]))
    )
    assert far == pytest.approx(near)
    assert near > 5


def test_time_orders_know_that_slices_are_missing() -> None:
    orders = time_orders(np.array([2, 3, 4, 6, 9]))
    assert list(orders) == [1, 2, 3, 4, 5, 6, 7]
    first = {interleave: order.tolist() for interleave, order in orders.items() if interleave <= 3}
    assert first == {1: [0, 1, 2, 3, 4], 2: [0, 2, 3, 1, 4], 3: [1, 3, 4, 2, 0]}


def test_the_interleave_of_the_least_movement_is_the_true_one(head: Phantom) -> None:
    for interleave in (1, 2, 3, 5):
        level = MotionLevel(walk_deg=0.7, walk_mm=0.4, n_jerks=2, jerk_deg=8, jerk_mm=5)
        slices, truth = as_slices(simulated(head, level, n_stacks=1, interleave=interleave))
        (sample,) = StackSamples.of_all(slices)
        assert estimate_interleave(truth, sample.slice_index, sample.pixels.center_mm) == interleave


def lattice(n: int) -> RigidPose:
    """Motions that shift the head by 0, 10, 20, ... mm."""
    return RigidPose(np.tile(np.eye(3), (n, 1, 1)), np.arange(n)[:, None] * np.array([[10.0, 0, 0]]))


def planted(
    interleave: int, truth_in_time: np.ndarray, n_states: int = 5, depth: float = 40.0
) -> tuple[np.ndarray, np.ndarray]:
    """Noisy costs [K, J] that are lowest for the true candidate, and the true candidate [K] of each slice."""
    n = len(truth_in_time)
    rng = np.random.default_rng(interleave)
    truth = np.empty(n, int)
    truth[acquisition_order(n, interleave)] = truth_in_time
    cost = rng.normal(0, 4, (n, n_states)) + depth
    cost[np.arange(n), truth] -= depth
    return cost, truth


@pytest.mark.parametrize("interleave", range(1, 8))
def test_planted_jerks_and_interleave_are_found(interleave: int) -> None:
    cost, truth = planted(interleave, np.repeat([1, 4, 2], [9, 7, 8]))
    segments = best_segments(cost, lattice(5), np.arange(24), CENTER_MM)
    np.testing.assert_array_equal(segments.choice, truth)
    assert segments.interleave == interleave
    assert segments.n_segments == 3


def test_the_cost_is_that_of_the_slices_and_of_the_changes() -> None:
    cost, truth = planted(2, np.repeat([1, 4], [12, 12]))
    segments = best_segments(cost, lattice(5), np.arange(24), CENTER_MM)
    moves = changes_in_time(lattice(5).take(truth), np.arange(24), CENTER_MM, 2)
    assert (moves > 1).sum() == 1
    assert moves.max() == pytest.approx(30)
    assert segments.cost == pytest.approx(cost[np.arange(24), truth].sum() + transition_penalty(moves))


@pytest.mark.parametrize(("depth", "interleave"), [(3.0, 1), (5.0, 5)])
def test_an_unusual_order_is_taken_only_where_it_explains_much_more(depth: float, interleave: int) -> None:
    """Few slices follow some order of seven by chance; sets that lost slices were put together by such orders."""
    truth = np.empty(24, int)
    truth[acquisition_order(24, 5)] = np.repeat([0, 1], [12, 12])
    cost = np.full((24, 2), depth)
    cost[np.arange(24), truth] = 0.0
    segments = best_segments(cost, lattice(2), np.arange(24), CENTER_MM)
    assert segments.interleave == interleave
    assert (segments.choice == truth).all() == (interleave == 5)


def test_one_slice_that_says_little_does_not_leave_its_run() -> None:
    cost, _ = planted(1, np.full(24, 2))
    cost[7] = 3.0
    cost[7, 0] = 0.0  # a damaged slice that fits slightly better elsewhere
    segments = best_segments(cost, lattice(5), np.arange(24), CENTER_MM)
    assert (segments.choice == 2).all()
    assert segments.n_segments == 1
    assert segments.interleave == 1  # the first of equally good ones


def test_missing_slices_do_not_break_the_interleave() -> None:
    cost, truth = planted(2, np.repeat([0, 3], [12, 12]))
    there = np.setdiff1d(np.arange(24), [0, 5, 6, 13])
    segments = best_segments(cost[there], lattice(5), there, CENTER_MM)
    np.testing.assert_array_equal(segments.choice, truth[there])
    assert segments.interleave == 2


def test_kept_candidates_are_considered_and_others_only_where_promising() -> None:
    """A motion that is never among the best of a window can be the best compromise."""
    orders = time_orders(np.arange(24))
    windows = [order[first : first + 5] for order in orders.values() for first in range(20)]
    cost = np.full((24, 6 * len(windows) + 1), 30.0)
    for number, window in enumerate(windows):
        cost[window, 6 * number : 6 * number + 6] = 0.0
    cost[:, -1] = 1.0
    motion, last = lattice(cost.shape[1]), cost.shape[1] - 1
    assert last not in promising(cost, orders)
    kept = best_segments(cost, motion, np.arange(24), CENTER_MM, keep=np.array([last]))
    assert (kept.choice == last).all()
    assert kept.cost == pytest.approx(24)
    free = best_segments(cost, motion, np.arange(24), CENTER_MM)
    assert free.n_segments > 1
    assert free.cost > kept.cost


@pytest.mark.parametrize("n_slices", [1, 2])
@pytest.mark.parametrize("n_candidates", [1, 3])
def test_very_few_slices_and_candidates(n_slices: int, n_candidates: int) -> None:
    cost = np.arange(n_slices * n_candidates, dtype=float).reshape(n_slices, n_candidates)
    segments = best_segments(cost, lattice(n_candidates), np.arange(n_slices) + 4, CENTER_MM)
    assert (segments.choice == 0).all()
    assert segments.n_segments == 1
    moves = changes_in_time(lattice(n_slices), np.arange(n_slices), CENTER_MM, 2)
    assert moves.shape == (n_slices - 1,)


def test_changes_cost_more_the_further_they_go_and_none_costs_nothing() -> None:
    assert transition_penalty(np.zeros(30)) == 0
    assert transition_penalty(np.zeros(0)) == 0
    penalties = [transition_penalty(np.array([0.0, d, 0])) for d in (0.01, 1.0, 4.0, 20.0, 80.0)]
    assert penalties == sorted(penalties)
    assert penalties[0] == pytest.approx(CHANGE_PENALTY, abs=0.01)
    assert penalties[-1] < 2 * penalties[-2]  # heavy-tailed, so that a jerk is possible
    two, one = transition_penalty(np.array([10.0, 10])), transition_penalty(np.array([20.0]))
    assert two > one
