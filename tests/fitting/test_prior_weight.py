"""The weight of V_prior in the volume follows how many pixels determine it."""

from __future__ import annotations

import numpy as np
import pytest

from g3r.fitting.prior_weight import FEWEST_STEPS, MAX_WEIGHT, SINGLE_STACK_WEIGHT, ended_early, prior_weight
from tests.fitting.scene import make_slices

SLICES = make_slices()
ONES = np.ones(len(SLICES))
N_PIXELS = len(SLICES.pixel_index)


def test_it_falls_with_the_root_of_the_pixels() -> None:
    assert prior_weight(0.3, SLICES, ONES, float(N_PIXELS)) == pytest.approx(0.3)
    assert prior_weight(0.3, SLICES, ONES, N_PIXELS / 4) == pytest.approx(0.15)
    assert prior_weight(0.0, SLICES, ONES, float(N_PIXELS)) == 0


def test_distrusted_slices_count_for_less() -> None:
    doubtful = 0.25 * ONES
    assert prior_weight(0.3, SLICES, doubtful, float(N_PIXELS)) == pytest.approx(0.6)


def test_it_has_a_bound_and_one_stack_a_weight_of_its_own() -> None:
    assert prior_weight(0.3, SLICES, ONES, 100.0 * N_PIXELS) == MAX_WEIGHT
    one = SLICES.take(SLICES.stack_id == SLICES.stack_id[0])
    assert prior_weight(0.3, one, ONES[: len(one)], 1.0) == SINGLE_STACK_WEIGHT
    assert prior_weight(0.0, one, ONES[: len(one)], 1.0) == 0


def test_a_fit_that_was_meant_to_be_short_has_not_ended_early() -> None:
    assert ended_early(FEWEST_STEPS - 1, 80)
    assert not ended_early(FEWEST_STEPS, 80)
    assert not ended_early(1, 1)
