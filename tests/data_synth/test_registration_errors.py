"""Simulated registration errors."""

import numpy as np
import pytest

from data_synth.motion import LEVELS, slice_trajectory
from data_synth.registration_errors import draw_residual_kind, mean_motion, residual_errors


def test_residual_errors_have_the_stated_size() -> None:
    stack_id, center = np.repeat([0, 1, 2], 40), np.random.default_rng(3).normal(size=(120, 3)) * 20
    lengths, angles = [], []
    for seed in range(40):
        error = residual_errors("small", stack_id, center, np.random.default_rng(seed))
        moved = np.linalg.norm(error.apply(center) - center, axis=1)
        lengths.append(np.sqrt((moved**2).mean()))
        angles.append(np.degrees(np.sqrt((error.rotvec_rad() ** 2).sum(1).mean())))
    # 0.1 to 0.8 mm and 0.2 to 1.2 degrees, plus a third for the tail
    assert min(lengths) > 0.08
    assert max(lengths) < 1.6
    assert 0.35 < np.mean(lengths) < 0.55
    assert 0.7 < np.mean(angles) < 1.2
    assert np.abs(residual_errors("none", stack_id, center, np.random.default_rng(0)).rotvec_rad()).max() == 0
    gross = residual_errors("gross", stack_id, center, np.random.default_rng(0))
    assert 2.0 < np.linalg.norm(gross.apply(center) - center, axis=1).max() < 20


def test_half_of_the_variance_is_shared_with_neighbours_of_the_same_stack() -> None:
    n_slices, edge = 40, 6  # the filter repeats the outermost values
    stack_id, center = np.repeat([0, 1, 2], n_slices), np.zeros((3 * n_slices, 3))
    within, across = [], []
    for seed in range(400):
        moved = residual_errors("small", stack_id, center, np.random.default_rng(seed)).translation_mm
        moved = (moved / np.sqrt((moved**2).mean())).reshape(3, n_slices, 3)
        inner = moved[:, edge:-edge]
        within.append((inner[:, :-1] * inner[:, 1:]).mean() / (inner**2).mean())
        across.append((moved[:-1, -1] * moved[1:, 0]).mean())
    # half of exp(-1 / (4 sigma^2)) with sigma 2, times E[f]^2 / E[f^2] of the factor f: 3 for a tenth, else 1
    expected = 0.5 * np.exp(-1 / 16) * 1.2**2 / 1.8
    assert np.mean(within) == pytest.approx(expected, abs=0.03)
    assert np.mean(across) == pytest.approx(0, abs=0.08)


def test_shares_of_residual_kinds() -> None:
    rng = np.random.default_rng(4)
    kinds = [draw_residual_kind(rng) for _ in range(2000)]
    assert abs(kinds.count("small") / 2000 - 0.65) < 0.04


def test_the_mean_motion_is_one_and_close_to_all() -> None:
    center = np.array([3.0, -40.0, 12.0])
    true = slice_trajectory(30, LEVELS["mild"], center, 2, np.random.default_rng(1))
    one = mean_motion(true, center)
    np.testing.assert_allclose(one.rotation, np.repeat(one.rotation[:1], 30, 0))
    away = np.linalg.norm(
        one.apply(np.tile(center, (30, 1, 1)))[:, 0] - true.apply(np.tile(center, (30, 1, 1)))[:, 0], axis=1
    )
    still = np.linalg.norm(true.apply(np.tile(center, (30, 1, 1)))[:, 0] - center, axis=1)
    assert away.mean() < 0.6 * still.mean()
    exact = mean_motion(true.take(np.full(30, 4)), center)
    np.testing.assert_allclose(exact.rotation, true.take(np.full(30, 4)).rotation, atol=1e-9)
    np.testing.assert_allclose(exact.translation_mm, true.take(np.full(30, 4)).translation_mm, atol=1e-6)
