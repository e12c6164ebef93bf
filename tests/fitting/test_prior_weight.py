"""The weight of V_prior in the volume depends on the number of pixels that determine it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.fitting.prior_weight import (
    FEWEST_STEPS,
    LAST_STEPS,
    MAX_WEIGHT,
    SINGLE_STACK_WEIGHT,
    ended_early,
    noise_of,
    prior_weight,
)
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_problem import QUIET
from tests.fitting.scene import make_slices, true_cloud

SLICES = make_slices()
ONES = np.ones(len(SLICES))
N_PIXELS = len(SLICES.pixel_index)


def test_it_falls_with_the_root_of_the_pixels() -> None:
    assert prior_weight(0.3, SLICES, ONES, float(N_PIXELS), QUIET) == pytest.approx(0.3)
    assert prior_weight(0.3, SLICES, ONES, N_PIXELS / 4, QUIET) == pytest.approx(0.15)
    assert prior_weight(0.0, SLICES, ONES, float(N_PIXELS), QUIET) == 0


def test_it_rises_with_the_root_of_noise_beyond_that_of_usual_stacks() -> None:
    quiet = prior_weight(0.3, SLICES, ONES, float(N_PIXELS), QUIET)
    assert prior_weight(0.3, SLICES, ONES, float(N_PIXELS), 0.1 * QUIET) == quiet
    assert prior_weight(0.3, SLICES, ONES, float(N_PIXELS), 4 * QUIET) == pytest.approx(2 * quiet)


def test_noise_is_what_the_end_of_the_fit_left_unexplained() -> None:
    left = np.abs(np.random.default_rng(0).normal(0, 0.08, 100_000)).mean()
    history = [{"image": 1.0}] * 10 + [{"image": float(left)}] * LAST_STEPS
    fit = SliceFit(cloud=true_cloud(), slices=SLICES, gain=ONES, weight=ONES, history=history, bias_field=[])
    assert noise_of(fit) == pytest.approx(0.08, rel=0.01)
    assert noise_of(replace(fit, history=[])) == 0


def test_distrusted_slices_count_for_less() -> None:
    doubtful = 0.25 * ONES
    assert prior_weight(0.3, SLICES, doubtful, float(N_PIXELS), QUIET) == pytest.approx(0.6)


def test_it_has_a_bound_and_one_stack_a_weight_of_its_own() -> None:
    assert prior_weight(0.3, SLICES, ONES, 100.0 * N_PIXELS, QUIET) == MAX_WEIGHT
    one = SLICES.take(SLICES.stack_id == SLICES.stack_id[0])
    assert prior_weight(0.3, one, ONES[: len(one)], 1.0, QUIET) == SINGLE_STACK_WEIGHT
    assert prior_weight(0.0, one, ONES[: len(one)], 1.0, QUIET) == 0


def test_a_fit_that_was_meant_to_be_short_has_not_ended_early() -> None:
    assert ended_early(FEWEST_STEPS - 1, 80)
    assert not ended_early(FEWEST_STEPS, 80)
    assert not ended_early(1, 1)
