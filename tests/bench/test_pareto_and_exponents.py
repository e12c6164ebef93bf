"""The Pareto front, and exponents of synthetic data."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.bench.scaling_tables import fitted_exponent
from g3r.bench.trade_tables import pareto_front


def test_front_has_what_no_other_point_beats() -> None:
    seconds = [10, 20, 30, 25, 5, 20]
    quality = [1.0, 3.0, 2.9, 3.5, 0.5, 2.0]
    assert pareto_front(seconds, quality) == [4, 0, 1, 3]


def test_of_equal_points_the_first_stays() -> None:
    assert pareto_front([1, 1, 1], [2, 2, 3]) == [2]
    assert pareto_front([1, 1], [2, 2]) == [0]
    assert pareto_front([1, 2], [2, 2]) == [0]
    assert pareto_front([], []) == []


def test_front_is_what_the_definition_says(rng: np.random.Generator) -> None:
    seconds, quality = rng.integers(0, 20, 60), rng.integers(0, 20, 60)
    front = pareto_front(seconds.tolist(), quality.tolist())
    for n in range(60):
        better = (seconds <= seconds[n]) & (quality >= quality[n])
        strictly = better & ((seconds < seconds[n]) | (quality > quality[n]))
        alike = (seconds == seconds[n]) & (quality == quality[n])
        assert (not strictly.any()) == (any(alike[k] for k in front))


def test_front_of_lists_that_do_not_belong_together() -> None:
    with pytest.raises(ValueError, match="2 times and 1 qualities"):
        pareto_front([1, 2], [1])


def test_exponent_of_a_power_law() -> None:
    size = [2.0**k for k in range(8)]
    found = fitted_exponent(size, [3 * n**1.1 for n in size])
    assert found.value == pytest.approx(1.1)
    assert found.spread == pytest.approx(0, abs=1e-6)
    assert found.n_sizes == 8


def test_spread_covers_noise(rng: np.random.Generator) -> None:
    size = 2.0 ** np.arange(8)
    off = []
    for _ in range(200):
        found = fitted_exponent(size.tolist(), (size * np.exp(0.1 * rng.standard_normal(8))).tolist())
        off.append((found.value - 1) / found.spread)
    assert np.mean(np.abs(off) < 2) > 0.8


def test_fixed_cost_does_not_count_in_the_largest_decade() -> None:
    size = [2.0**k for k in range(8)]
    cost = [n + 2 for n in size]
    all_sizes, decade = fitted_exponent(size, cost), fitted_exponent(size, cost, largest_decade=True)
    assert decade.n_sizes == 4
    assert all_sizes.value < 0.9 < decade.value < 1


@pytest.mark.parametrize(("size", "cost"), [([1], [1]), ([1, 2], [1]), ([1, 2], [1, 0]), ([2, 2], [1, 1])])
def test_exponent_needs_two_positive_sizes(size: list[int], cost: list[int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        fitted_exponent(size, cost)
