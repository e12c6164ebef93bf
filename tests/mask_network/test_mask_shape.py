"""From the pixels that a network calls brain to the outline that a person would draw."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.mask_network.mask_shape import RIM_MM, as_people_draw, cleaned

SPACING_MM = np.array([0.8, 1.1, 3.0])


def test_parts_of_a_moving_head_stay_and_holes_are_filled() -> None:
    mask = np.zeros((60, 60, 6), dtype=bool)
    for k in range(6):  # a head that jumps sideways half way
        shift = 0 if k < 3 else 12
        mask[10 + shift : 25 + shift, 10:30, k] = True
    holes = mask.copy()
    holes[15, 15, 1] = False
    holes[50:53, 50:53, 2] = True  # far off
    np.testing.assert_array_equal(cleaned(holes, np.array([1.0, 1.0, 4.0])), mask)
    assert not cleaned(np.zeros((4, 4, 4), dtype=bool), np.ones(3)).any()


@pytest.mark.parametrize("at_edge", [False, True])
def test_the_rim_is_in_the_plane_and_as_wide_as_it_says(at_edge: bool) -> None:
    mask = np.zeros((60, 60, 5), dtype=bool)
    mask[0 if at_edge else 20 : 40, 20:40, 2] = True
    grown = as_people_draw(mask, SPACING_MM)
    assert not grown[:, :, [1, 3]].any()
    assert (grown & mask).sum() == mask.sum()
    beyond = [int(RIM_MM / mm) for mm in SPACING_MM[:2]]
    rows, columns = np.flatnonzero(grown.any((1, 2))), np.flatnonzero(grown.any((0, 2)))
    assert rows[-1] == 39 + beyond[0]
    assert columns[[0, -1]].tolist() == [20 - beyond[1], 39 + beyond[1]]


def test_nothing_stays_nothing() -> None:
    assert not as_people_draw(np.zeros((9, 9, 3), dtype=bool), SPACING_MM).any()
