"""Slice weights: smooth, never zero, and high for most slices."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.acquisition.robust import DARK, DROPPED_WEIGHT, MAX_DROPPED_SHARE, robust_width, slice_weights

Array = NDArray[np.float64]


def weights(loss: Array) -> Array:
    """Weights of equally bright slices."""
    return slice_weights(loss, np.full(len(loss), 1.3), n_stacks=3)


def test_slice_weights_are_smooth_and_never_zero() -> None:
    rng = np.random.default_rng(0)
    usual = rng.normal(1.0, 0.1, 200).clip(0.1)
    previous = None
    for bad in np.linspace(0.9, 5, 1500):
        weight = weights(np.append(usual, bad))
        assert weight.min() > 0
        assert weight.max() == 1.0
        if previous is not None:
            assert weight[-1] <= previous + 1e-12
            assert previous - weight[-1] < 0.02
        previous = weight[-1]
    assert previous is not None
    assert previous <= 2e-3
    assert np.median(weights(usual)) == 1.0
    assert (weights(np.zeros(5)) == 1).all()
    assert (weights(np.full(5, 3.3)) == 1).all()
    for a, b in itertools.pairwise((1e-6, 1.0, 1e6)):  # the unit of the loss does not matter
        np.testing.assert_allclose(weights(usual * a), weights(usual * b), rtol=1e-3)


@pytest.mark.parametrize("bad_share", [0.1, 0.3, 0.45])
@pytest.mark.parametrize("n", [10, 49, 200])
def test_at_most_a_share_of_the_slices_is_dropped(n: int, bad_share: float) -> None:
    rng = np.random.default_rng(n)
    loss = rng.normal(1.0, 0.05, n)
    bad = rng.permutation(n)[: int(bad_share * n)]
    loss[bad] += rng.uniform(5, 50, len(bad))
    weight = weights(loss)
    assert (weight < DROPPED_WEIGHT).sum() <= MAX_DROPPED_SHARE * n
    assert (weight < DROPPED_WEIGHT).sum() == min(len(bad), int(MAX_DROPPED_SHARE * n))
    assert weight.min() > 0
    # the dropped slices are the worst, and every bad slice weighs less than every good one
    dropped = np.flatnonzero(weight < DROPPED_WEIGHT)
    assert loss[dropped].min() > np.median(loss) + 4
    assert weight[bad].max() < np.delete(weight, bad).min()


def test_no_slice_of_a_single_stack_is_dropped_but_dark_ones() -> None:
    """A volume that does not follow a slice fits it badly, and no other stack shows that part."""
    loss, gain = np.append(np.linspace(0.9, 1.1, 30), [20.0, 15.0, 0.0]), np.append(np.ones(32), 0.03)
    assert (slice_weights(loss, gain, 2)[[-3, -2, -1]] < 0.01).all()
    weight = slice_weights(loss, gain, 1)
    np.testing.assert_array_equal(weight[-3:-1], DROPPED_WEIGHT)
    assert weight[-1] < 0.01
    assert (weight[:-3] == 1).all()


def test_a_slice_without_signal_counts_for_nothing() -> None:
    """A gain near zero explains it whatever the volume, so its residual is the smallest of all."""
    loss, gain = np.full(9, 1.0), np.full(9, 1.2)
    loss[4], gain[4] = 0.0, 0.03
    weight = slice_weights(loss, gain, 3)
    assert weight[4] < 0.01
    assert (np.delete(weight, 4) == 1).all()
    steps = np.geomspace(1e-6, 1.0, 200)
    falling = [slice_weights(np.ones(9), np.append(np.ones(8), one), 3)[-1] for one in steps]
    assert min(falling) > 0
    assert (np.diff(falling) >= 0).all()
    assert slice_weights(np.ones(9), np.append(np.ones(8), DARK), 3)[-1] == 1.0
    np.testing.assert_allclose(slice_weights(loss, 1e3 * gain, 3), weight)  # the unit of gains does not matter


@pytest.mark.parametrize("n_sigma", [1.0, 2.0, 3.0])
def test_the_robust_width_is_the_standard_deviation_without_outliers(rng: np.random.Generator, n_sigma: float) -> None:
    residual = rng.normal(0, 0.3, 20_000)
    residual[::50] = 100.0
    assert robust_width(residual, n_sigma) == pytest.approx(n_sigma * 0.3, rel=0.05)
    assert robust_width(np.zeros(5)) > 0
