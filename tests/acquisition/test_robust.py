"""Weights of slices: smooth, never zero, and most slices keep theirs."""

import itertools

import numpy as np
import pytest

from g3r.acquisition.robust import DROPPED_WEIGHT, MAX_DROPPED_SHARE, robust_width, slice_weights


def test_slice_weights_are_smooth_and_never_zero() -> None:
    rng = np.random.default_rng(0)
    usual = rng.normal(1.0, 0.1, 200).clip(0.1)
    previous = None
    for bad in np.linspace(0.9, 5, 1500):
        weight = slice_weights(np.append(usual, bad))
        assert weight.min() > 0
        assert weight.max() == 1.0
        if previous is not None:
            assert weight[-1] <= previous + 1e-12
            assert previous - weight[-1] < 0.02
        previous = weight[-1]
    assert previous is not None
    assert previous <= 2e-3
    assert np.median(slice_weights(usual)) == 1.0
    assert (slice_weights(np.zeros(5)) == 1).all()
    assert (slice_weights(np.full(5, 3.3)) == 1).all()
    for a, b in itertools.pairwise((1e-6, 1.0, 1e6)):  # a pure number of the loss
        np.testing.assert_allclose(slice_weights(usual * a), slice_weights(usual * b), rtol=1e-3)


@pytest.mark.parametrize("bad_share", [0.1, 0.3, 0.45])
@pytest.mark.parametrize("n", [10, 49, 200])
def test_at_most_a_share_of_the_slices_is_dropped(n: int, bad_share: float) -> None:
    rng = np.random.default_rng(n)
    loss = rng.normal(1.0, 0.05, n)
    bad = rng.permutation(n)[: int(bad_share * n)]
    loss[bad] += rng.uniform(5, 50, len(bad))
    weight = slice_weights(loss)
    assert (weight < DROPPED_WEIGHT).sum() <= MAX_DROPPED_SHARE * n
    assert (weight < DROPPED_WEIGHT).sum() == min(len(bad), int(MAX_DROPPED_SHARE * n))
    assert weight.min() > 0
    # those dropped are the worst, and all that are bad count less than all that are good
    dropped = np.flatnonzero(weight < DROPPED_WEIGHT)
    assert loss[dropped].min() > np.median(loss) + 4
    assert weight[bad].max() < np.delete(weight, bad).min()


@pytest.mark.parametrize("n_sigma", [1.0, 2.0, 3.0])
def test_the_robust_width_is_the_standard_deviation_without_outliers(rng: np.random.Generator, n_sigma: float) -> None:
    residual = rng.normal(0, 0.3, 20_000)
    residual[::50] = 100.0
    assert robust_width(residual, n_sigma) == pytest.approx(n_sigma * 0.3, rel=0.05)
    assert robust_width(np.zeros(5)) > 0
