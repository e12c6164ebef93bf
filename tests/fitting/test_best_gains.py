"""Best gains of slices."""

import numpy as np

from g3r.fitting.best_gains import best_gains


def test_gains_are_those_of_least_squares_and_empty_slices_get_the_given_one() -> None:
    rng = np.random.default_rng(0)
    plane = np.repeat([0, 1, 3], 40)
    predicted, weight = rng.uniform(0.5, 2, 120), rng.uniform(0, 1, 120)
    measured = predicted * np.array([0.8, 1.2, 0.0, 1.5])[plane] + rng.normal(0, 0.01, 120)
    gain = best_gains(weight, predicted, measured, plane, 5, of_nothing=1)
    for k in (0, 1, 3):
        own = plane == k
        root = np.sqrt(weight[own])
        best = np.linalg.lstsq((root * predicted[own])[:, None], root * measured[own], rcond=None)[0]
        np.testing.assert_allclose(gain[k], best[0], rtol=1e-12)
    assert gain[2] == gain[4] == 1
    assert (best_gains(weight, 0 * predicted, measured, plane, 5, of_nothing=0) == 0).all()
