"""Quality: stacks that are not registered are unreliable, good ones are not; few slices are down-weighted."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from data_synth.phantom import Phantom, fetal_brain_phantom
from data_synth.simulator import SimulatedStack
from g3r.acquisition.robust import DROPPED_WEIGHT, MAX_DROPPED_SHARE
from g3r.registration import Registration, RegistrationSettings, register
from g3r.registration.overlap import Overlap
from g3r.registration.quality import (
    left_out_notes,
    pose_warnings,
    registration_reliable,
    registration_summary,
    stack_qualities,
)
from g3r.registration.stack_quality import StackQuality
from g3r.registration.thresholds import (
    IN_PLACE_NCC,
    LEEWAY,
    MIN_HELD_OUT,
    MIN_MISFIT_WITHOUT,
    MIN_NCC,
    MIN_OVERLAP_CORRELATION,
    MIRRORED_BELOW,
)
from tests.registration.moving_heads import STILL, Moving, as_slices, simulated
from tests.report.records import quality

QUICK = RegistrationSettings(network=False, stacks=False, segments=False, n_rounds=2, finest_voxel_mm=1.8)


def qualities(stacks: list[SimulatedStack]) -> list[StackQuality]:
    slices, _ = as_slices(stacks)
    return stack_qualities(register(slices, QUICK), len(stacks))


def noise_instead(one: SimulatedStack) -> SimulatedStack:
    """Stacks with the same masks and brightness but noise instead of the head."""
    rng = np.random.default_rng(0)
    image = one.stack.image.copy()
    image[one.stack.mask] = rng.permutation(image[one.stack.mask])
    return replace(one, stack=replace(one.stack, image=image))


def held_out(one: StackQuality) -> float:
    assert one.held_out_correlation is not None
    return one.held_out_correlation


def test_stacks_that_are_registered_are_reliable(still: list[SimulatedStack], moving: Moving) -> None:
    assert all(one.reliable for one in qualities(still))
    found = stack_qualities(moving.estimate, 3)
    assert all(one.reliable for one in found)
    assert [one.held_out_correlation for one in found] == moving.estimate.held_out
    stacks = [one.stack for one in moving.stacks]
    assert pose_warnings(found, stacks) == []
    assert registration_summary(found).startswith("3 of 3 stacks are registered")


def test_a_stack_of_noise_is_not_reliable(still: list[SimulatedStack]) -> None:
    found = qualities([still[0], noise_instead(still[1]), still[2]])
    assert [one.reliable for one in found] == [True, False, True]
    assert found[1].median_slice_ncc is not None
    assert found[1].median_slice_ncc < 0.5


def test_a_stack_of_another_head_is_not_reliable(still: list[SimulatedStack]) -> None:
    other = simulated(fetal_brain_phantom(33, 1.2, 9), STILL, seed=4)
    found = qualities([still[0], other[1], still[2]])
    assert not found[1].reliable
    assert held_out(found[1]) < min(held_out(one) for one in qualities(still)) - 0.15


def test_stacks_left_far_apart_are_not_reliable(head: Phantom, moving: Moving) -> None:
    """Uncorrected severe motion is reported for each stack, with names and figures."""
    estimate = register(moving.slices, replace(QUICK, n_rounds=0))
    found = stack_qualities(estimate, 3)
    assert not any(one.reliable for one in found)
    stacks = [one.stack for one in moving.stacks]
    lines = pose_warnings(found, stacks)
    assert len(lines) == 3
    for line, stack, one in zip(lines, stacks, found, strict=True):
        assert line.startswith(f"{stack.name}: registration probably failed")
        assert f"{one.held_out_correlation:.2f}" in line
        assert "do not rely on" in line
    assert registration_summary(found).startswith("0 of 3")


def estimate_with(held_out: list[float] | None, ncc: list[float], weight: list[float], ids: list[int]) -> Any:
    return SimpleNamespace(
        profiles=[],
        overlap=None,
        handedness=None,
        misfit_without=None,
        left_out=[],
        median_move_mm=[0.0] * len(set(ids)),
        slices=SimpleNamespace(stack_id=np.array(ids)),
        held_out=held_out,
        ncc=np.array(ncc),
        weight=np.array(weight),
    )


@pytest.mark.parametrize(
    ("held_out", "ncc", "weight", "reliable"),
    [
        (0.8, 0.95, 1.0, True),
        (MIN_HELD_OUT - 0.01, IN_PLACE_NCC - 0.01, 1.0, False),
        (MIN_HELD_OUT - LEEWAY - 0.01, 0.99, 1.0, False),
        (MIN_HELD_OUT - LEEWAY, IN_PLACE_NCC, 1.0, True),
        (0.8, MIN_NCC - 0.01, 1.0, False),
        (0.8, 0.95, 0.4, False),
    ],
)
def test_every_figure_can_call_a_stack_unreliable(held_out: float, ncc: float, weight: float, reliable: bool) -> None:
    ids = [0] * 4 + [1] * 4
    estimate = estimate_with([0.8, held_out], [0.95] * 4 + [ncc] * 4, [1.0] * 4 + [weight, weight, weight, 1], ids)
    found = stack_qualities(estimate, 2)
    assert [one.reliable for one in found] == [True, reliable]
    assert found[1].record() == {
        "reliable": reliable,
        "held_out_correlation": held_out,
        "median_slice_ncc": ncc,
        "downweighted_share": 0.75 if weight < 0.5 else 0.0,
        "median_move_mm": 0.0,
        "n_missing": 0,
        "longest_gap_mm": 0.0,
        "is_cut": False,
        "overlap_share": None,
        "overlap_correlation": None,
        "handedness": None,
        "misfit_without": None,
        "left_out": False,
    }


@pytest.mark.parametrize(("share", "reliable"), [(1.0, True), (0.5, False)])
def test_a_good_fit_counts_where_others_saw_the_stack(share: float, reliable: bool) -> None:
    """Where no other stack covers, a stack would only be compared with itself."""
    estimate = estimate_with([0.8, 0.8], [IN_PLACE_NCC] * 2, [1.0] * 2, [0, 1])
    estimate.overlap = SimpleNamespace(stack_share=[1.0, share], correlation=[0.9, MIN_OVERLAP_CORRELATION - LEEWAY])
    assert [one.reliable for one in stack_qualities(estimate, 2)] == [True, reliable]


@pytest.mark.parametrize(("hand", "reliable"), [(0.2, True), (None, True), (MIRRORED_BELOW - 0.01, False)])
def test_a_mirror_image_of_two_others_is_not_reliable_and_called_by_its_name(
    still: list[SimulatedStack], hand: float | None, reliable: bool
) -> None:
    estimate = estimate_with([0.8] * 3, [0.95] * 3, [1.0] * 3, [0, 1, 2])
    estimate.handedness = [0.2, 0.2, hand]
    found = stack_qualities(estimate, 3)
    assert [one.reliable for one in found] == [True, True, reliable]
    lines = pose_warnings(found, [one.stack for one in still])
    assert len(lines) == (0 if reliable else 1)
    assert all(line.startswith(f"{still[2].stack.name}: probably a mirror image") for line in lines)


@pytest.mark.parametrize(("ncc", "reliable"), [(0.85, [True, False, True]), (MIN_NCC - 0.01, [False, True, True])])
def test_a_stack_is_one_too_many_where_no_other_failed(ncc: float, reliable: list[bool]) -> None:
    estimate = estimate_with([0.8] * 3, [ncc, 0.85, 0.85], [1.0] * 3, [0, 1, 2])
    estimate.misfit_without = [None, MIN_MISFIT_WITHOUT - 0.1, None]
    assert [one.reliable for one in stack_qualities(estimate, 3)] == reliable


def test_a_stack_without_slices_is_named_and_shifts_nobody(still: list[SimulatedStack]) -> None:
    """Figures belong to the stacks that have slices, whatever their numbers."""
    estimate = estimate_with([0.7, 0.9], [0.95] * 4, [1.0] * 4, [0, 0, 2, 2])
    found = stack_qualities(estimate, 3)
    assert [one.held_out_correlation for one in found] == [0.7, None, 0.9]
    assert [one.reliable for one in found] == [True, False, True]
    lines = pose_warnings(found, [one.stack for one in still])
    assert len(lines) == 1
    assert lines[0].startswith(f"{still[1].stack.name}: no slice")
    assert registration_summary(found) == (
        "2 of 3 stacks are registered; correlation with the others: 0.70, none, 0.90"
    )


def test_a_stack_that_was_left_out_does_not_make_the_others_unreliable(still: list[SimulatedStack]) -> None:
    estimate = estimate_with([0.7, 0.9], [0.95] * 4, [1.0] * 4, [0, 0, 2, 2])
    estimate.left_out = [(1, quality(False, 0.31, 0.8, left_out=True))]
    found = stack_qualities(estimate, 3)
    assert registration_reliable(found)
    assert registration_summary(found).startswith(
        "2 of 3 stacks are registered; 1 left out; correlation with the others: 0.70, 0.31"
    )
    stacks = [one.stack for one in still]
    assert pose_warnings(found, stacks) == []
    (line,) = left_out_notes(found, stacks)
    assert line.startswith(
        f"{still[1].stack.name}: left out of the volume, it does not fit the other stacks (agreement 0.31"
    )
    mirrored = [one if n != 1 else replace(one, handedness=MIRRORED_BELOW - 0.1) for n, one in enumerate(found)]
    (line,) = pose_warnings(mirrored, stacks)
    assert line.startswith(f"{still[1].stack.name}: left out of the volume, it is probably a mirror image")
    assert left_out_notes(mirrored, stacks) == []


def test_the_estimates_own_weights_keep_to_it(moving: Moving) -> None:
    weight = moving.estimate.weight
    assert isinstance(moving.estimate, Registration)
    assert (weight < DROPPED_WEIGHT).mean() <= MAX_DROPPED_SHARE
    assert weight.max() == 1.0


def test_a_single_stack_with_a_hole_is_warned_about(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still[:1])
    middle = len(slices) // 2
    holed = slices.take(np.setdiff1d(np.arange(len(slices)), np.arange(middle - 1, middle + 2)))
    estimate = register(holed, QUICK)
    found = stack_qualities(estimate, 1)
    (line,) = pose_warnings(found, [still[0].stack])
    assert found[0].n_missing == 3
    assert found[0].reliable is None
    assert "3 slices are missing" in line
    assert "what the header says" in line
    whole = register(slices, QUICK)
    assert pose_warnings(stack_qualities(whole, 1), [still[0].stack]) == []


@pytest.mark.parametrize(
    ("share", "correlation", "reliable"), [(0.5, 0.75, True), (0.1, 0.75, False), (0.5, 0.4, False)]
)
def test_stacks_that_share_little_are_not_reliable(
    moving: Moving, share: float, correlation: float, reliable: bool
) -> None:
    n = len(moving.estimate.slices)
    overlap = Overlap(seen_share=np.ones(n), stack_share=[1.0, share, 1.0], correlation=[0.9, correlation, 0.9])
    estimate = replace(moving.estimate, overlap=overlap)
    found = stack_qualities(estimate, 3)
    assert [one.reliable for one in found] == [True, reliable, True]
    lines = pose_warnings(found, [one.stack for one in moving.stacks])
    assert len(lines) == (not reliable)
    assert all(f"others saw {share:.0%} of it" in line for line in lines)
