"""Schedules of weights and step sizes during a fit."""

import math

import numpy as np
import pytest

from g3r.errors import InputError
from g3r.fitting.schedules import AnnealedWeight, cosine_decay


def test_annealed_weight_at_and_between_its_ends() -> None:
    weight = AnnealedWeight(0.5, 0.1, 0.2, 0.8)
    assert weight.at(0.0) == weight.at(0.1999) == 0.5
    assert weight.at(0.2) == 0.5
    assert weight.at(0.5) == pytest.approx(0.3)
    assert weight.at(0.35) == pytest.approx(0.4)
    assert weight.at(0.8) == weight.at(0.9) == weight.at(1.0) == 0.1
    values = [weight.at(f) for f in np.linspace(0, 1, 500)]
    assert (np.diff(values) <= 1e-15).all()
    assert np.abs(np.diff(values)).max() < 0.002  # no jump


def test_annealed_weight_with_equal_fractions_is_a_step() -> None:
    weight = AnnealedWeight(0.5, 0.1, 0.4, 0.4)
    assert weight.at(0.4 - 1e-9) == 0.5
    assert weight.at(0.4) == 0.1


@pytest.mark.parametrize(("tau", "first", "last"), [(0.0, 0.1, 0.1), (1.0, 0.5, 0.1)])
def test_annealed_weight_at_the_borders(tau: float, first: float, last: float) -> None:
    weight = AnnealedWeight(0.5, 0.1, tau, tau)
    assert (weight.at(0.0), weight.at(1.0)) == (first, last)


def test_annealed_weight_may_grow_and_may_be_zero() -> None:
    assert AnnealedWeight(0.0, 1.0, 0.0, 1.0).at(0.25) == 0.25
    assert AnnealedWeight(0.0, 0.0).at(0.5) == 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        (0.5, 0.1, 0.8, 0.2),
        (0.5, 0.1, -0.1, 0.5),
        (0.5, 0.1, 0.5, 1.1),
        (0.5, 0.1, math.nan, 0.5),
        (-0.5, 0.1),
        (0.5, -0.1),
        (math.nan, 0.1),
        (math.inf, 0.1),
    ],
)
def test_annealed_weight_refuses(arguments: tuple[float, float, float, float] | tuple[float, float]) -> None:
    with pytest.raises(InputError, match="expected"):
        AnnealedWeight(*arguments)


def test_cosine_decay() -> None:
    assert cosine_decay(0.0) == cosine_decay(0.39) == 1.0
    assert cosine_decay(0.4) == pytest.approx(1.0)
    assert cosine_decay(0.7) == pytest.approx((1 + 0.05) / 2)
    assert cosine_decay(1.0) == pytest.approx(0.05)
    values = [cosine_decay(f) for f in np.linspace(0, 1, 300)]
    assert (np.diff(values) <= 0).all()
