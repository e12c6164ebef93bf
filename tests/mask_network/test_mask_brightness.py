"""Measures of a stack by brightness alone: detail and uneven brightness."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.mask_network.brightness import detail_inside, evened

SPACING_MM = np.array([1.0, 1.2, 3.0])


def ball(shape: tuple[int, int, int], radius_mm: float) -> np.ndarray:
    at = (np.indices(shape) - np.reshape(np.array(shape) // 2, (3, 1, 1, 1))) * SPACING_MM[:, None, None, None]
    return np.linalg.norm(at, axis=0) < radius_mm


def test_folds_are_detail_and_noise_shading_and_the_edge_are_not(rng: np.random.Generator) -> None:
    inside = ball((100, 90, 30), 35.0)
    across = np.arange(100)[:, None, None] * SPACING_MM[0]
    folds = 1 + 0.2 * np.sin(2 * np.pi * across / 20) * np.ones(inside.shape)
    shaded = (1 + across / 200) * inside + rng.normal(0, 0.05, inside.shape)
    small = detail_inside(shaded.astype(np.float32), inside, SPACING_MM)
    large = detail_inside((shaded * folds).astype(np.float32), inside, SPACING_MM)
    assert small < 0.012
    # smoothing a wave of 20 mm by 2 mm leaves 0.82 of it and by 6 mm 0.17; its standard deviation is 0.14
    assert large == pytest.approx((0.82 - 0.17) * 0.14, rel=0.2)


def test_detail_has_no_unit_and_needs_room(rng: np.random.Generator) -> None:
    inside = ball((60, 60, 12), 20.0)
    image = rng.random(inside.shape, dtype=np.float32)
    np.testing.assert_allclose(
        detail_inside(image * 700, inside, SPACING_MM), detail_inside(image, inside, SPACING_MM), rtol=1e-4
    )
    assert np.isnan(detail_inside(image, ball(inside.shape, 8.0), SPACING_MM))
    assert np.isnan(detail_inside(image, np.zeros_like(inside), SPACING_MM))


def test_a_dark_half_becomes_as_bright_as_the_other(rng: np.random.Generator) -> None:
    image = rng.uniform(0.5, 1.0, (200, 120, 4)).astype(np.float32)
    image[100:] *= 0.2
    even = evened(image, np.array([2.0, 2.0, 3.0]))
    assert 0.9 < even[140:].mean() / even[:60].mean() < 1.1
    assert not evened(np.zeros((9, 9, 2), np.float32), SPACING_MM).any()


def test_noise_in_air_stays_dark() -> None:
    image = np.ones((200, 100, 2), np.float32)
    image[100:] = 0.01
    assert evened(image, np.array([2.0, 2.0, 3.0]))[160:].max() < 0.2
