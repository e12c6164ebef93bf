"""Mask shape: from the pixels that a network calls brain to an outline like a hand-drawn one."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.mask_network.mask_shape import (
    RIM_MM,
    as_people_draw,
    cleaned,
    without_clefts,
    without_doubtful_ends,
    without_outgrowths,
)

SPACING_MM = np.array([0.8, 1.1, 3.0])


def test_parts_of_a_moving_head_stay_and_holes_are_filled() -> None:
    mask = np.zeros((60, 60, 6), dtype=bool)
    for k in range(6):  # a head that jumps sideways at mid-stack
        shift = 0 if k < 3 else 12
        mask[10 + shift : 25 + shift, 10:30, k] = True
    holes = mask.copy()
    holes[15, 15, 1] = False
    holes[50:53, 50:53, 2] = True  # far away
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


def ellipsoid(shape: tuple[int, int, int], radius_mm: tuple[float, float, float]) -> np.ndarray:
    x = (np.indices(shape) - np.reshape(np.array(shape) // 2, (3, 1, 1, 1))) * SPACING_MM[:, None, None, None]
    return ((x / np.reshape(radius_mm, (3, 1, 1, 1))) ** 2).sum(0) < 1


def test_an_ellipsoid_stays_whole_and_what_sticks_out_goes() -> None:
    head = ellipsoid((120, 100, 40), (35.0, 45.0, 38.0))
    probability = np.where(head, 0.9, 0.7)
    np.testing.assert_array_equal(without_outgrowths(head, probability, SPACING_MM), head)
    face = head.copy()
    face[55:70, 45:60, 36:] = True  # starts 10 mm below the head's end
    face &= ~head
    left = without_outgrowths(head | face, probability, SPACING_MM)
    assert (left & head).sum() == head.sum()
    assert (left & face).sum() < 0.3 * face.sum()


@pytest.mark.parametrize("slices", [slice(2, 3), slice(0, 0)])
def test_one_slice_or_none_is_not_judged(slices: slice) -> None:
    mask = np.zeros((30, 30, 5), dtype=bool)
    mask[5:25, 8:20, slices] = True
    np.testing.assert_array_equal(without_outgrowths(mask, np.ones(mask.shape), SPACING_MM), mask)


def test_doubtful_sections_at_the_ends_go_and_those_between_stay() -> None:
    mask = np.zeros((20, 20, 9), bool)
    mask[5:15, 5:15, 1:8] = True
    probability = np.where(mask, np.array([0, 0.4, 0.5, 0.9, 0.3, 0.9, 0.8, 0.55, 0]), 0).astype(np.float32)
    kept = without_doubtful_ends(mask, probability)
    assert np.flatnonzero(kept.any((0, 1))).tolist() == [3, 4, 5, 6]
    np.testing.assert_array_equal(kept[:, :, 3:7], mask[:, :, 3:7])
    assert not without_doubtful_ends(mask, probability * 0.5).any()


@pytest.mark.parametrize("at_edge", [False, True])
def test_clefts_of_a_section_are_filled_and_wide_bays_stay(at_edge: bool) -> None:
    whole = np.zeros((100, 90, 4), bool)
    whole[0 if at_edge else 10 : 90, 10:80, 1:3] = True
    cleft, bay = whole.copy(), whole.copy()
    cleft[45:50, 10:50, 1] = False  # 4 mm wide
    bay[20:80, 10:60, 1] = False  # 48 mm
    assert (without_clefts(cleft, SPACING_MM) ^ whole).sum() < 10  # the disc leaves a dent at the mouth
    filled = without_clefts(bay, SPACING_MM) & ~bay
    assert filled.sum() < 0.1 * (whole & ~bay).sum()  # the closing disc does not reach into the corners of the bay
    np.testing.assert_array_equal(without_clefts(whole, SPACING_MM), whole)
