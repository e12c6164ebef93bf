"""A stack is left out if, and only if, it does not fit the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from data_synth.simulator import SimulatedStack
from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.registration import Registration, register, register_robustly
from g3r.registration.given import with_pixels_of
from g3r.registration.misfits import misfits
from g3r.registration.stack_quality import StackQuality, unlike_others
from g3r.registration.thresholds import MIN_CROSSING_DEG
from g3r.run.deadline import Deadline
from g3r.run.stage_file import as_stored
from tests.registration.moving_heads import Moving, as_slices
from tests.registration.test_quality import QUICK, noise_instead
from tests.report.records import quality

GOOD, FAILED = quality(True, 0.8, 0.95), quality(False, 0.3, 0.8)
UNLIKE = quality(True, 0.8, 0.85)
MIRRORED = replace(GOOD, handedness=-0.1)  # possible for one of two stacks


def with_noise(still: list[SimulatedStack], place: int) -> list[SimulatedStack]:
    return [noise_instead(one) if n == place else one for n, one in enumerate(still)]


def same(a: Registration, b: Registration) -> bool:
    return np.array_equal(a.slices.planes.pose.translation_mm, b.slices.planes.pose.translation_mm)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_stack_of_noise_is_left_out_wherever_it_stands(still: list[SimulatedStack], place: int) -> None:
    slices, _ = as_slices(with_noise(still, place))
    found = register_robustly(slices, QUICK)
    ((number, left_out),) = found.left_out
    assert number == place
    assert left_out.left_out
    assert left_out.reliable is False
    others = slices.stack_id != place
    assert set(found.slices.stack_id) == {0, 1, 2} - {place}
    assert same(found, register(slices.take(others), QUICK))
    assert as_stored(found).left_out == found.left_out


def test_stacks_that_fit_all_stay(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    found = register_robustly(slices, QUICK)
    assert found.left_out == []
    assert same(found, register(slices, QUICK))


def test_it_can_be_switched_off(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(with_noise(still, 1))
    assert register_robustly(slices, replace(QUICK, leave_out_misfits=False)).left_out == []


def test_of_two_stacks_nobody_says_which_is_wrong(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(with_noise(still, 1)[:2])
    assert register_robustly(slices, QUICK).left_out == []


@pytest.mark.parametrize(
    ("qualities", "expected"),
    [
        ([GOOD, GOOD, GOOD], []),
        ([GOOD, FAILED, GOOD], [1]),
        ([UNLIKE, GOOD, GOOD], [0]),
        ([GOOD, FAILED, FAILED], []),
        ([GOOD, FAILED], []),
        ([GOOD, FAILED, GOOD, UNLIKE], []),
        ([GOOD, FAILED, GOOD, UNLIKE, GOOD], [1, 3]),
    ],
)
def test_most_stacks_decide(qualities: list[StackQuality], expected: list[int]) -> None:
    assert misfits(qualities) == expected


def test_a_failed_stack_is_not_called_unlike_the_others_as_well() -> None:
    assert unlike_others([GOOD, FAILED, UNLIKE]) == [2]
    assert unlike_others([GOOD, replace(UNLIKE, left_out=True)]) == []


def test_all_stay_where_the_others_do_not_fit_without_it_either(
    still: list[SimulatedStack], monkeypatch: pytest.MonkeyPatch
) -> None:
    slices, _ = as_slices(with_noise(still, 1))
    monkeypatch.setattr("g3r.registration.stack_quality.MIN_HELD_OUT", 0.99)
    monkeypatch.setattr("g3r.registration.stack_quality.LEEWAY", 0.0)
    monkeypatch.setattr("g3r.registration.misfits.misfits", lambda qualities: [1])
    assert register_robustly(slices, QUICK).left_out == []


@pytest.mark.parametrize(("angle_deg", "expected"), [(MIN_CROSSING_DEG - 1, []), (MIN_CROSSING_DEG, [1])])
def test_all_stay_where_the_others_would_not_check_each_other(
    still: list[SimulatedStack], monkeypatch: pytest.MonkeyPatch, angle_deg: float, expected: list[int]
) -> None:
    slices, _ = as_slices(with_noise(still, 1))
    monkeypatch.setattr("g3r.registration.misfits.crossing_deg", lambda slices: angle_deg)
    assert [n for n, _ in register_robustly(slices, QUICK).left_out] == expected


def test_the_registration_serves_for_all_stacks_again(still: list[SimulatedStack]) -> None:
    """`reconstruct(stacks, registration)` does not expect slices of the stack that was left out."""
    slices, _ = as_slices(with_noise(still, 2))
    found = register_robustly(slices, QUICK)
    assert len(with_pixels_of(slices, found).slices) == len(found.slices)
    with pytest.raises(InputError, match="register the same stacks"):
        with_pixels_of(slices, replace(found, left_out=[]))


def as_registered(moving: Moving, calls: list[int] | None = None) -> Callable[..., Registration]:
    """Replace registration by one that keeps all slices in place and takes no time."""

    def register_(slices: Slices, *others: Any, **options: Any) -> Registration:
        if calls is not None:
            calls.append(len(slices))
        return replace(moving.estimate, slices=slices)

    return register_


def agreeing(correlation: float, *, fits: bool = True) -> list[StackQuality]:
    return [replace(GOOD, held_out_correlation=correlation, reliable=fits)] * 2


@pytest.mark.parametrize(
    ("without", "expected"),
    [
        ({0: agreeing(0.5, fits=False), 1: agreeing(0.8), 2: agreeing(0.6, fits=False)}, 1),
        ({0: agreeing(0.8), 1: agreeing(0.8), 2: agreeing(0.6, fits=False)}, None),
        ({0: agreeing(0.5, fits=False), 1: agreeing(0.5, fits=False), 2: agreeing(0.6, fits=False)}, None),
        ({0: agreeing(0.5, fits=False), 1: agreeing(0.7), 2: agreeing(0.6, fits=False)}, None),
        ({0: agreeing(0.5, fits=False), 1: [GOOD, UNLIKE], 2: agreeing(0.6, fits=False)}, None),
        ({0: agreeing(0.5, fits=False), 1: [GOOD, MIRRORED], 2: agreeing(0.6, fits=False)}, None),
    ],
    ids=["one fits without", "two do", "none does", "only just", "unlike each other", "a mirror image"],
)
def test_where_all_failed_each_is_left_out_in_its_turn(
    moving: Moving, monkeypatch: pytest.MonkeyPatch, without: dict[int, list[StackQuality]], expected: int | None
) -> None:
    def qualities(found: Registration, n_stacks: int) -> list[StackQuality]:
        present = set(found.slices.stack_id.tolist())
        absent = {0, 1, 2} - present
        left = iter(without[absent.pop()] if absent else [FAILED] * 3)
        return [next(left) if n in present else GOOD for n in range(n_stacks)]

    monkeypatch.setattr("g3r.registration.misfits.stack_qualities", qualities)
    monkeypatch.setattr("g3r.registration.misfits.register", as_registered(moving))
    found = register_robustly(moving.slices, QUICK)
    assert [n for n, _ in found.left_out] == ([] if expected is None else [expected])
    assert set(found.slices.stack_id) == {0, 1, 2} - {expected}
    assert all(one == replace(FAILED, left_out=True) for _, one in found.left_out)


def test_there_is_no_turn_without_time_for_it(moving: Moving, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr("g3r.registration.misfits.register", as_registered(moving, calls))
    monkeypatch.setattr("g3r.registration.misfits.stack_qualities", lambda found, n_stacks: [FAILED] * n_stacks)
    assert register_robustly(moving.slices, QUICK, deadline=Deadline.after(0.0)).left_out == []
    assert len(calls) == 1
    register_robustly(moving.slices, QUICK, deadline=Deadline.after(600.0))
    assert len(calls) == 5
