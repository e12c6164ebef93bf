"""Share done and time left, with a clock that the test controls."""

from __future__ import annotations

import pytest

from g3r.cli.infer_options import parsed_options
from g3r.cli.time_left import EXPECTED_S, POSE_ROUNDS, TimeLeft, expected_seconds
from g3r.planning import PRESET_NAMES
from g3r.planning.presets import PRESETS
from g3r.planning.stages import Stage
from g3r.report.stage_words import DOING, FINDING_MASKS, LINES, PREPARING, STARTING, WITHOUT_FACTS

STACKS = ("--stacks", "a.nii", "b.nii", "--output", "o")


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def time_left(clock: Clock) -> TimeLeft:
    return TimeLeft({"one": 10.0, "two": 30.0, "three": 60.0}, clock)


def test_as_expected_the_bar_follows_the_clock(clock: Clock, time_left: TimeLeft) -> None:
    time_left.begun("one")
    assert time_left.share() == 0
    assert time_left.left_s() == pytest.approx(100)
    clock.now_s += 5
    assert time_left.share() == pytest.approx(0.05)
    assert time_left.left_s() == pytest.approx(95)
    clock.now_s += 5
    time_left.ended("one")
    time_left.begun("two")
    assert time_left.share() == pytest.approx(0.1)
    clock.now_s += 30
    time_left.ended("two")
    assert time_left.share() == pytest.approx(0.4)
    clock.now_s += 60
    time_left.ended("three")
    assert time_left.share() == 1
    assert time_left.left_s() == 0


def test_a_slow_machine_needs_longer_for_the_rest(clock: Clock, time_left: TimeLeft) -> None:
    time_left.begun("one")
    clock.now_s += 40  # four times slower than expected
    assert time_left.share() < 0.1
    time_left.ended("one")
    assert 200 < time_left.left_s() < 360
    time_left.begun("two")
    shares = []
    for _ in range(200):
        clock.now_s += 1
        shares.append(time_left.share())
    assert shares == sorted(shares)
    assert 0.3 < shares[-1] < 0.4
    assert time_left.left_s() > 0


def test_many_steps_tell_better_than_the_clock(clock: Clock, time_left: TimeLeft) -> None:
    time_left.begun("three")  # the earlier stages were skipped
    assert time_left.share() == pytest.approx(0.4)
    clock.now_s += 50
    time_left.progress(1, 100)
    assert time_left.share() < 0.42
    time_left.progress(50, 100)
    assert time_left.share() == pytest.approx(0.7)


def test_a_stage_that_nobody_expected_changes_nothing(clock: Clock, time_left: TimeLeft) -> None:
    time_left.begun("one")
    time_left.ended("one")
    time_left.begun("surprise")
    clock.now_s += 3
    assert time_left.share() == pytest.approx(0.1)
    time_left.ended("surprise")
    assert time_left.share() == pytest.approx(0.1)


def test_stages_are_those_of_a_run_and_have_words() -> None:
    assert set(EXPECTED_S) == set(PRESET_NAMES)
    for preset in PRESET_NAMES:
        stages = expected_seconds(parsed_options([*STACKS, "--preset", preset]), compiling=True)
        assert set(stages) - {str(stage) for stage in Stage} <= {STARTING, FINDING_MASKS, PREPARING}
        assert set(stages) <= set(DOING)
    assert {stage for stage, _ in LINES.values()} <= set(DOING)
    assert {*WITHOUT_FACTS.values()} <= set(LINES)
    assert {str(stage) for stage in Stage} <= set(DOING)


def test_what_the_options_say_is_expected() -> None:
    def total(*further: str, compiling: bool = False) -> float:
        return sum(expected_seconds(parsed_options([*STACKS, *further]), compiling=compiling).values())

    masks = ("--masks", "m.nii", "n.nii")
    assert total() > total(*masks) > total(*masks, "--preset", "preview") > total(*masks, "--dry-run")
    assert total(compiling=True) > total()
    assert total("--time-budget", "90") == pytest.approx(90)
    assert "prior share" not in expected_seconds(parsed_options([*STACKS, "--no-prior"]), compiling=False)
    three = parsed_options(["--stacks", "a.nii", "b.nii", "c.nii", "--output", "o"])
    rounds = str(Stage.POSE_ROUNDS)
    assert rounds in expected_seconds(parsed_options(STACKS), compiling=False)
    assert rounds not in expected_seconds(three, compiling=False)


@pytest.mark.parametrize("preset", PRESET_NAMES)
def test_rounds_are_those_of_the_preset(preset: str) -> None:
    assert POSE_ROUNDS[preset] == tuple(PRESETS[preset].pose_rounds.n_rounds(n) for n in (1, 2, 3))


def test_each_round_is_expected() -> None:
    def rounds_s(n_stacks: int, preset: str) -> float:
        options = parsed_options(["--stacks", *"abc"[:n_stacks], "--output", "o", "--preset", preset])
        return expected_seconds(options, compiling=False).get(str(Stage.POSE_ROUNDS), 0.0)

    one = rounds_s(3, "accurate")
    assert one > 0
    assert rounds_s(2, "accurate") == pytest.approx(2 * one)
    assert rounds_s(2, "fast") > rounds_s(3, "fast") == 0
