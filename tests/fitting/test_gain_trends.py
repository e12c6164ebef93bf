"""A ridge on trends of gains sees lines and parabolas along a stack, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.fitting.gain_trends import GainTrends
from g3r.planning.presets import PRESETS, adapted
from tests.acquisition.nifti_files import stacks_of_two


@pytest.fixture
def slices() -> Slices:
    return slices_from_stacks(stacks_of_two())


def along(slices: Slices, stack: int) -> np.ndarray:
    """Places of a stack's slices in units of 40 mm, from their middle, and zero for other stacks."""
    own, header = slices.stack_id == stack, slices.header_pose
    place = header.translation_mm @ header.rotation[np.flatnonzero(own)[0], :, 2] / 40.0
    return np.where(own, place - place[own].mean(), 0.0)


def test_a_line_and_a_parabola_cost_their_coefficients(slices: Slices) -> None:
    trends, place = GainTrends(slices), along(slices, 1)
    n = 2 * len(np.unique(slices.stack_id))
    assert trends.penalty(0.3 * place - 0.2 * place**2)[0] == pytest.approx((0.3**2 + 0.2**2) / n)


def test_what_tells_stacks_apart_is_free(slices: Slices) -> None:
    value, gradient = GainTrends(slices).penalty(0.4 * slices.stack_id + 0.1)
    assert value == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(gradient, 0, atol=1e-9)


def test_the_gradient_is_the_finite_difference(slices: Slices, rng: np.random.Generator) -> None:
    trends, change = GainTrends(slices), rng.normal(0, 0.1, len(slices))
    _, gradient = trends.penalty(change)
    for k in range(len(slices)):
        step = np.eye(len(slices))[k] * 1e-5
        slope = (trends.penalty(change + step)[0] - trends.penalty(change - step)[0]) / 2e-5
        assert gradient[k] == pytest.approx(slope, abs=1e-7)


def test_one_slice_has_no_trend(slices: Slices) -> None:
    value, gradient = GainTrends(slices.take(np.array([3]))).penalty(np.array([0.2]))
    assert value == 0
    np.testing.assert_array_equal(gradient, [0.0])


def test_trends_are_held_from_three_stacks_on() -> None:
    held = [adapted(PRESETS["fast"], n).slice_stage.gain_trend_ridge for n in (1, 2, 3)]
    assert held[:2] == [0.0, 0.0]
    assert held[2] > 0
