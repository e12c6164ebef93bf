"""Attempts of the global search: where each begins, when they end, and which result is taken."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from data_synth.simulator import SimulatedStack
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.geometry import RigidPose
from g3r.registration import RegistrationSettings
from g3r.registration.global_search import GlobalSearch, _Candidate
from g3r.registration.similarity import StackSamples
from g3r.registration.thresholds import RETRY_BELOW_CORRELATION, RETRY_WITH_TEMPLATE_BELOW
from g3r.run.deadline import Deadline
from tests.registration.moving_heads import Moving, as_slices

ELSEWHERE = [RigidPose.from_rotvec(np.eye(3) * angle, np.zeros((3, 3))) for angle in (0.0, 0.5, 1.0, 1.5)]
"""Motions of three stacks that differ from attempt to attempt."""

LOW, HIGH = RETRY_BELOW_CORRELATION - 0.01, RETRY_BELOW_CORRELATION + 0.01


class Told(GlobalSearch):
    """A search whose attempts are told what they find: cost, lowest correlation, and motion of each stack."""

    finds: Sequence[tuple[float, float]]
    places: Sequence[RigidPose]
    begun: list[tuple[str, int]]

    def _in_segments(self, start: _Candidate, others: Sequence[RigidPose], *_: Any) -> _Candidate:
        cost, lowest = self.finds[len(self.begun)]
        self.begun.append((start.name, len(others)))
        score: Any = SimpleNamespace(cost=cost, correlations=[lowest, 0.9])
        return _Candidate(start.name, self.places[len(self.begun) - 1].take(self.slices.stack_id), score)


def told(
    still: list[SimulatedStack],
    finds: Sequence[tuple[float, float]],
    deadline: Deadline | None = None,
    places: Sequence[RigidPose] = ELSEWHERE,
) -> tuple[list[tuple[str, int]], float]:
    """Initialisations and numbers of other motions of the attempts, and the cost of the result."""
    slices = as_slices(still)[0]
    settings = RegistrationSettings(attempts=len(finds))
    search = Told(slices, StackSamples.of_all(slices), settings, None)
    object.__setattr__(search, "finds", finds)
    object.__setattr__(search, "places", places)
    object.__setattr__(search, "begun", [])
    found = search.run({"network": RigidPose.identity(len(slices))}, deadline)
    assert found.score is not None
    return search.begun, found.score.cost


def test_one_attempt_is_enough_where_the_stacks_predict_each_other(still: list[SimulatedStack]) -> None:
    begun, cost = told(still, [(-1e6, HIGH), (-2e6, HIGH), (-3e6, HIGH)])
    assert len(begun) == 1
    assert cost == -1e6


def test_each_attempt_begins_elsewhere_and_the_last_has_what_the_others_found(still: list[SimulatedStack]) -> None:
    begun, cost = told(still, [(-1e6, LOW), (-3e6, LOW), (-2e6, LOW), (-2.5e6, LOW)])
    assert sorted(name for name, _ in begun[:3]) == ["headers", "network", "stacks"]
    assert begun[3] == (begun[1][0], 3)  # at the best so far, with the motions of three attempts
    assert cost == -3e6


def test_an_attempt_that_finds_nothing_better_changes_nothing(still: list[SimulatedStack]) -> None:
    _, cost = told(still, [(1e9, LOW)] * 3)
    assert cost < 0


def test_two_attempts_that_agree_are_enough(still: list[SimulatedStack]) -> None:
    """Also where one has all slices elsewhere, as long as they lie to each other as in the other."""
    together = RigidPose.from_rotvec([[0.0, 0.0, 1.0]], [[20.0, 0.0, 0.0]])
    alike = RigidPose.concatenated([together @ ELSEWHERE[1].take([n]) for n in range(3)])
    begun, cost = told(still, [(-1e6, LOW), (-2e6, LOW), (-3e6, LOW)], places=[ELSEWHERE[1], alike, ELSEWHERE[2]])
    assert len(begun) == 2
    assert cost == -2e6


def test_no_attempt_begins_after_the_deadline(still: list[SimulatedStack]) -> None:
    begun, _ = told(still, [(-1e6, LOW)] * 3, Deadline.after(-1.0))
    assert len(begun) == 1


@pytest.mark.parametrize(("lowest", "attempts"), [(RETRY_WITH_TEMPLATE_BELOW, 1), (HIGH, 3)])
def test_a_template_that_stands_for_what_is_missing_says_less(
    moving: Moving, template: AtlasTemplate, lowest: float, attempts: int
) -> None:
    slices = moving.slices
    seen = slices.take((slices.stack_id != 0) | (np.abs(slices.slice_index - 10) > 2))
    search = Told(seen, StackSamples.of_all(seen), RegistrationSettings(attempts=3, stacks=False), template)
    object.__setattr__(search, "finds", [(-1e6, lowest)] * 3)
    object.__setattr__(search, "places", ELSEWHERE)
    object.__setattr__(search, "begun", [])
    found = search.run({})
    assert found.fill is not None
    assert len(search.begun) == attempts
