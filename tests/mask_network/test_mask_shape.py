"""From the pixels that a network calls brain to the outline that a person would draw."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.mask_network.mask_shape import MIN_SOLID, RIM_MM, TONGUE_MM, as_people_draw, cleaned, without_tongues

SPACING_MM = np.array([0.8, 1.1, 3.0])


def ellipsoid(shape: tuple[int, int, int] = (90, 70, 14)) -> NDArray[np.bool_]:
    """A head of 50 x 50 x 36 mm."""
    index = np.moveaxis(np.indices(shape), 0, -1) - (np.array(shape) - 1) / 2
    return (((index * SPACING_MM) / [25, 25, 18]) ** 2).sum(-1) < 1


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


def test_a_compact_head_stays_as_it_is() -> None:
    head = ellipsoid()
    assert np.count_nonzero(without_tongues(head, SPACING_MM) ^ head) < 0.02 * np.count_nonzero(head)


def test_thin_tongues_go() -> None:
    head = ellipsoid()
    leak = head.copy()
    leak[44:47, 50:66, 7] = True  # 2.4 mm wide
    assert leak[:, 62:, 7].any()
    assert not without_tongues(leak, SPACING_MM)[:, 62:, 7].any()


def test_the_mask_ends_before_a_section_that_is_not_compact() -> None:
    head = ellipsoid()
    face = np.zeros_like(head)
    face[30:60, 20:29, :3] = face[30:39, 20:50, :3] = True  # two thick bars at a right angle
    hull_share = (30 * 9 + 9 * 30 - 81) / (30 * 30 - 21 * 21 / 2)
    assert hull_share < MIN_SOLID
    face[:, :, 3:] = head[:, :, 3:]
    found = without_tongues(face, SPACING_MM)
    assert not found[:, :, :3].any()
    np.testing.assert_array_equal(found[:, :, 4:], without_tongues(head, SPACING_MM)[:, :, 4:])


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
    empty, speck = np.zeros((9, 9, 3), dtype=bool), np.zeros((9, 9, 3), dtype=bool)
    speck[4, 4, 1] = True  # smaller than a tongue
    assert TONGUE_MM > 1
    for mask in (empty, speck):
        assert not without_tongues(mask, SPACING_MM).any()
    assert not as_people_draw(empty, SPACING_MM).any()
