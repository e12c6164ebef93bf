"""Intruders: a stack of another head is found by the gain of the others without it, even if it fits equally well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_synth.phantom import fetal_brain_phantom
from data_synth.simulator import SimulatedStack
from g3r.acquisition.planes import Slices
from g3r.registration.intruder import misfit_without_each
from g3r.registration.slice_rounds import FittedSlices, correlation_with_all
from g3r.registration.stack_quality import shortfalls
from g3r.registration.thresholds import IN_PLACE_NCC, MIN_MISFIT_WITHOUT
from tests.registration.moving_heads import STILL, as_slices, simulated
from tests.report.records import quality

VOXEL_MM, MAX_PIXELS = 1.8, 100_000


def fitted(slices: Slices) -> FittedSlices:
    ones = np.ones(len(slices))
    ncc = correlation_with_all(slices, ones, ones, VOXEL_MM, MAX_PIXELS)
    return FittedSlices(slices=slices, gain=ones, weight=ones, ncc=ncc, history=[])


def noisy(slices: Slices) -> Slices:
    """Stacks so noisy that no slice fits as well as usual slices in place."""
    noise = np.random.default_rng(0).normal(0, 0.15, slices.value.shape)
    return replace(slices, value=(slices.value + noise).astype(np.float32))


@pytest.mark.parametrize("which", [0, 1, 2])
def test_others_fit_each_other_without_a_stack_of_another_head(still: list[SimulatedStack], which: int) -> None:
    other = simulated(fetal_brain_phantom(28, 1.2, 9), STILL, seed=4)
    slices = as_slices([other[n] if n == which else one for n, one in enumerate(still)])[0]
    left = misfit_without_each(fitted(slices), VOXEL_MM, MAX_PIXELS)
    assert left is not None
    assert [one is not None for one in left] == [n == which for n in range(3)]
    assert (left[which] or 1.0) < MIN_MISFIT_WITHOUT


def test_noise_stays_without_any_of_them(still: list[SimulatedStack]) -> None:
    left = misfit_without_each(fitted(noisy(as_slices(still)[0])), VOXEL_MM, MAX_PIXELS)
    assert left is not None
    assert min(one for one in left if one is not None) > MIN_MISFIT_WITHOUT


def test_stacks_in_place_and_those_that_have_no_two_others_are_not_asked(still: list[SimulatedStack]) -> None:
    in_place = fitted(as_slices(still)[0])
    ncc = np.where(in_place.slices.stack_id == 1, IN_PLACE_NCC, 0.8)  # one stack is enough
    assert misfit_without_each(replace(in_place, ncc=ncc), VOXEL_MM, MAX_PIXELS) is None
    assert misfit_without_each(fitted(noisy(as_slices(still[:2])[0])), VOXEL_MM, MAX_PIXELS) is None


def test_the_reason_says_how_much_better_the_others_fit() -> None:
    good = quality(True, 0.8, 0.88, misfit_without=MIN_MISFIT_WITHOUT)
    assert shortfalls(good) == []
    (line,) = shortfalls(replace(good, misfit_without=0.45))
    assert line == "the other stacks fit each other 55% better without it; good is 40% or less"
