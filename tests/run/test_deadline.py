"""Loops that end by their number of steps or by the clock."""

from collections.abc import Callable
from typing import Any

import pytest

from g3r.run.deadline import Deadline, timed_steps


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def run(
    n_steps: int, seconds: float, per_step: float | Callable[[int], float], **options: Any
) -> tuple[list[tuple[int, float]], float]:
    clock, done = Clock(), []
    deadline = Deadline.after(seconds, clock)
    for step, fraction in timed_steps(n_steps, deadline, **options):
        done.append((step, fraction))
        clock.now += per_step(step) if callable(per_step) else per_step
    return done, clock.now - 100.0


def test_without_a_deadline_all_steps_are_made() -> None:
    assert list(timed_steps(4)) == [(0, 0.0), (1, 0.25), (2, 0.5), (3, 0.75)]


def test_with_time_enough_all_steps_are_made() -> None:
    done, _ = run(4, 100, 1.0)
    assert done == list(timed_steps(4))


@pytest.mark.parametrize("seconds", [3.0, 10.0, 33.3])
def test_the_deadline_is_kept_and_used(seconds: float) -> None:
    _done, took = run(1000, seconds, 0.5)
    assert seconds - 0.5 <= took <= seconds


def test_the_fraction_rises_to_the_end_of_the_schedule() -> None:
    done, _ = run(1000, 20.0, 0.5)
    fractions = [fraction for _, fraction in done]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0
    assert 0.9 < fractions[-1] < 1


def test_steps_that_become_slower_shorten_the_schedule() -> None:
    done, took = run(1000, 20.0, lambda step: 0.1 if step < 20 else 0.5)
    fractions = [fraction for _, fraction in done]
    assert fractions == sorted(fractions)
    assert fractions[-1] > 0.85
    assert took <= 21


def test_a_deadline_that_has_passed_allows_the_least() -> None:
    done, _ = run(10, -5.0, 1.0, least=3)
    assert [step for step, _ in done] == [0, 1, 2]


def test_a_part_leaves_the_reserve() -> None:
    clock = Clock()
    deadline = Deadline.after(20.0, clock)
    part = deadline.part(0.5, reserve_s=4.0)
    assert part.remaining_s == pytest.approx(8.0)
    assert deadline.part(0.5, reserve_s=40.0).remaining_s == 0.0
