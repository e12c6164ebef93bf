"""Acquisition order of slices."""

import numpy as np
import pytest

from g3r.acquisition.interleave import acquisition_order, place_in_time


@pytest.mark.parametrize(
    ("n_slices", "interleave", "expected"),
    [
        (5, 1, [0, 1, 2, 3, 4]),
        (5, 2, [0, 2, 4, 1, 3]),
        (8, 3, [0, 3, 6, 1, 4, 7, 2, 5]),
        (2, 3, [0, 1]),
        (1, 2, [0]),
        (0, 2, []),
    ],
)
def test_small_orders(n_slices: int, interleave: int, expected: list[int]) -> None:
    order = acquisition_order(n_slices, interleave)
    assert order.tolist() == expected
    assert order.dtype == np.int64


@pytest.mark.parametrize("interleave", [1, 2, 3])
@pytest.mark.parametrize("n_slices", [11, 12, 40])
def test_every_slice_is_taken_once(n_slices: int, interleave: int) -> None:
    order = acquisition_order(n_slices, interleave)
    assert sorted(order) == list(range(n_slices))
    steps = np.diff(order)
    assert (steps[: n_slices // interleave - 1] == interleave).all()
    assert (steps < 0).sum() == interleave - 1  # the number of returns to the beginning


def test_an_interleave_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="interleave 0"):
        acquisition_order(5, 0)


@pytest.mark.parametrize("interleave", [1, 2, 3])
def test_places_in_time_are_the_inverse_of_the_order(interleave: int) -> None:
    assert place_in_time(7, interleave)[acquisition_order(7, interleave)].tolist() == list(range(7))
