"""Total variation: its operator is the gradient of its value, and it preserves edges."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.total_variation import diffusivity, divergence_of_gradient

TIP = 0.05


@pytest.fixture
def volume(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(5, 6, 7)).astype(np.float32)


def test_it_is_symmetric_and_not_negative(volume: np.ndarray, rng: np.random.Generator) -> None:
    other = rng.normal(size=volume.shape).astype(np.float32)
    weight = diffusivity(rng.normal(size=volume.shape).astype(np.float32), TIP)
    across = float((other * divergence_of_gradient(volume, weight)).sum())
    assert across == pytest.approx(float((volume * divergence_of_gradient(other, weight)).sum()), rel=1e-3)
    assert float((volume * divergence_of_gradient(volume, weight)).sum()) > 0


def test_a_constant_has_none(volume: np.ndarray) -> None:
    assert np.abs(divergence_of_gradient(np.full_like(volume, 3), None)).max() < 1e-6


def test_with_its_own_weights_it_is_half_the_length_of_the_gradient(volume: np.ndarray) -> None:
    """x^T D^T W D x with W = 1 / (2 |Dx|) is |Dx| / 2 wherever the rounded tip is negligible."""
    length = np.sqrt(sum(np.diff(volume, axis=a, append=np.take(volume, [-1], a)) ** 2 for a in range(3)))
    energy = float((volume * divergence_of_gradient(volume, diffusivity(volume, 1e-6))).sum())
    assert energy == pytest.approx(0.5 * float(length.sum()), rel=1e-3)


def test_edges_are_smoothed_less_than_what_is_small() -> None:
    step = np.zeros((4, 4, 8), np.float32)
    step[..., 4:] = 1
    weight = diffusivity(step, TIP)
    assert weight[0, 0, 3] < 0.1 * weight[0, 0, 0]
