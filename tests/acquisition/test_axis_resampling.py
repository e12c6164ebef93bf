"""Resampling along axes: exact on linear ramps, averaging at coarser spacing, zero beyond the samples."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.axis_resampling import along_axes, axis_weights, centred_positions_mm


@pytest.mark.parametrize("new_mm", [0.7, 1.1, 3.0, 4.4])
def test_straight_lines_stay(new_mm: float) -> None:
    at = np.arange(12.0, 40.0, new_mm)
    weights = axis_weights(50, 1.1, at, new_mm)
    np.testing.assert_allclose(weights.sum(1), np.ones(len(at)), atol=1e-6)
    # the hat is symmetric about a new sample but the old samples are not: the error is a fraction of their distance
    off = np.abs(weights @ (np.arange(50) * 1.1) - at)
    assert off.max() < (0.1 * 1.1 if new_mm > 1.1 else 1e-4)


def test_the_same_samples_give_the_same_values() -> None:
    np.testing.assert_allclose(axis_weights(7, 2.0, np.arange(7) * 2.0, 2.0), np.eye(7), atol=1e-7)


def test_coarser_samples_average_noise(rng: np.random.Generator) -> None:
    noise = rng.normal(size=4000).astype(np.float32)
    found = axis_weights(4000, 1.0, np.arange(10.0, 3900.0, 4.0), 4.0) @ noise
    assert found.std() == pytest.approx(np.sqrt(2 / 3 / 4), rel=0.15)  # of a hat of half width 4


def test_beyond_is_zero() -> None:
    weights = axis_weights(5, 1.0, np.array([-3.0, -0.5, 2.0, 4.5, 9.0]), 1.0)
    np.testing.assert_allclose(weights.sum(1), [0, 0.5, 1, 0.5, 0], atol=1e-6)


def test_each_axis_has_its_own(rng: np.random.Generator) -> None:
    volume = rng.random((6, 8, 5)).astype(np.float32)
    weights = [axis_weights(n, 1.0, centred_positions_mm(m, 1.0, n, 1.0), 1.0) for n, m in [(6, 4), (8, 8), (5, 7)]]
    found = along_axes(volume, weights)
    assert found.shape == (4, 8, 7)
    np.testing.assert_allclose(found[:, :, 1:6], volume[1:5], atol=1e-6)
    assert not found[:, :, [0, 6]].any()
