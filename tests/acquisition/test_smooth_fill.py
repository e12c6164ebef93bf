"""The smooth continuation keeps measured values, and fills only with means of them."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.smooth_fill import smooth_fill

SHAPE = (30, 26, 40)
Z = np.broadcast_to(np.arange(SHAPE[2], dtype=np.float32), SHAPE)
NOISE = np.random.default_rng(0).uniform(1, 2, SHAPE).astype(np.float32)


def known_outside(low: int, high: int) -> np.ndarray:
    return ((low > Z) | (high <= Z)).astype(np.float32)


def test_what_was_measured_stays() -> None:
    known = known_outside(12, 25)
    filled = smooth_fill(NOISE, known)
    assert filled.dtype == np.float32
    np.testing.assert_array_equal(filled[known == 1], NOISE[known == 1])


@pytest.mark.parametrize("width", [1, 4, 12, 30])
def test_a_constant_is_continued_and_noise_averaged(width: int) -> None:
    known = known_outside(5, 5 + width)
    np.testing.assert_allclose(smooth_fill(np.full(SHAPE, 3, np.float32), known), 3, rtol=1e-4)
    unknown = smooth_fill(NOISE, known)[known == 0]
    assert 1 <= unknown.min() <= unknown.max() <= 2
    assert unknown.std() < 0.6 * NOISE.std()
    assert unknown.mean() == pytest.approx(1.5, abs=0.05)


def test_unknown_values_play_no_part() -> None:
    known = known_outside(12, 25)
    other = np.where(known == 0, np.float32(1e6), NOISE)
    np.testing.assert_array_equal(smooth_fill(other, known), smooth_fill(NOISE, known))


def test_it_is_the_near_side_that_is_continued() -> None:
    known = known_outside(10, 30)
    filled = smooth_fill(np.where(Z < 20, 1, 5).astype(np.float32), known).mean((0, 1))
    assert filled[10] == pytest.approx(1, abs=0.02)
    assert filled[29] == pytest.approx(5, abs=0.02)
    assert (np.diff(filled) > -1e-3).all()
    assert 1.5 < filled[[19, 20]].mean() < 4.5


def test_half_a_weight_is_half_a_voice() -> None:
    known = np.ones(SHAPE, np.float32)
    known[15, 13, 20] = 0.5
    values = np.zeros(SHAPE, np.float32)
    values[15, 13, 20] = 8
    filled = smooth_fill(values, known)
    # neighbouring voxels contain a little of it
    assert 4 < filled[15, 13, 20] < 4.3
    assert np.delete(filled.ravel(), np.ravel_multi_index((15, 13, 20), SHAPE)).max() == 0


def test_far_from_all_that_is_known_there_is_nothing() -> None:
    assert (smooth_fill(NOISE, np.zeros(SHAPE, np.float32)) == 0).all()
    known = np.zeros(SHAPE, np.float32)
    known[0, 0, 0] = 1
    filled = smooth_fill(NOISE, known)
    assert np.isfinite(filled).all()
    assert filled.max() == pytest.approx(NOISE[0, 0, 0], rel=1e-3)
    assert filled[-1, -1, -1] < 0.1 * NOISE[0, 0, 0]
