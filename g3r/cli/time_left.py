"""Progress and remaining time of a run: expected seconds of its stages, corrected by the measured ones."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping

from g3r.cli.mask_options import AUTO
from g3r.report.stage_words import FINDING_MASKS, LOADING, PREPARING, STARTING, WRITING
from g3r.run.kernel_cache import COMPILING_FIT_S

BEFORE_S = {STARTING: 0.3, FINDING_MASKS: 0.5, LOADING: 0.3, PREPARING: 0.4}
"""Seconds of the steps before the first stage of the run context, for three stacks on two cores."""

ROUNDS = "poses in rounds"

AFTER_S = {"prior share": 1.2, "uncertainty": 0.6, WRITING: 1.2}

EXPECTED_S = {
    "preview": {"registration": 3.5, "coarse volume": 1.0, "prior": 0.7, "volume": 0.3},
    "fast": {
        "registration": 3.5,
        "coarse volume": 1.2,
        "prior": 1.8,
        "poses in rounds": 4.0,
        "fit to prior": 1.0,
        "fit to slices": 3.4,
        "volume": 0.3,
    },
    "balanced": {
        "registration": 7.0,
        "coarse volume": 1.4,
        "prior": 1.6,
        "poses in rounds": 4.0,
        "fit to prior": 1.1,
        "held-out slices": 3.0,
        "fit to slices": 4.2,
        "volume": 1.5,
    },
    "accurate": {
        "registration": 7.0,
        "coarse volume": 1.4,
        "prior": 1.6,
        "poses in rounds": 6.0,
        "fit to prior": 1.1,
        "held-out slices": 4.2,
        "fit to slices": 27.0,
        "volume": 1.5,
    },
}
"""Seconds of each preset by stage, in their order, for three stacks on two cores and compiled programs; `ROUNDS` is
one round."""

POSE_ROUNDS = {"preview": (0, 0, 0), "fast": (1, 1, 0), "balanced": (1, 2, 0), "accurate": (1, 2, 1)}
"""Rounds of poses and volume with one stack, two, and more. A test keeps them equal to those of the presets, which are
too slow to import here."""

COMPILING_S = {
    "registration": 9.0,
    "coarse volume": 1.0,
    "poses in rounds": 27.0,
    "fit to prior": 3.0,
    "held-out slices": 2.0,
}
"""Additional seconds of stages if numba has compiled nothing yet."""

MASK_S = 8.0
"""Seconds for the network to find the brain in one stack."""

ONLY_WITH_PRIOR = ("prior share",)
ONLY_WITH_FIT = ("prior share", "uncertainty")

STEADY_S = 5.0
"""Weight of the expected pace against the measured one, in seconds."""

MANY_STEPS = 10
"""With at least this many steps, the share of a stage follows from its steps alone, not from the clock."""

EVEN = 0.7
"""Share of a stage's expected seconds up to which its share grows with the clock; beyond, it slows down."""

NEARLY = 0.97
"""Largest share of a stage that counts as done before it has ended."""


def expected_seconds(options: argparse.Namespace, *, compiling: bool) -> dict[str, float]:
    """Seconds of each stage of a run, in their order.

    Args:
        options: options of g3r-infer.
        compiling: whether programs have to be compiled.
    """
    before = dict(BEFORE_S)
    n_to_find = 0
    if not (options.whole_image or options.mask_command or options.slices):
        given = options.masks or []
        n_to_find = sum(one == AUTO for one in given) if given else max(len(options.stacks), 3)
    before[FINDING_MASKS] += MASK_S * n_to_find
    if options.dry_run:
        return before
    preset = "balanced" if options.time_budget else options.preset
    stages = before | EXPECTED_S[preset] | AFTER_S
    if n_rounds := POSE_ROUNDS[preset][min(len(options.stacks or ()) or 3, 3) - 1]:
        stages[ROUNDS] *= n_rounds
    else:
        stages.pop(ROUNDS, None)
    if options.preset == "preview" and not options.time_budget:
        stages = {name: seconds for name, seconds in stages.items() if name not in ONLY_WITH_FIT}
    if options.no_prior:
        stages = {name: seconds for name, seconds in stages.items() if name not in ONLY_WITH_PRIOR}
    if compiling:
        stages = {name: seconds + COMPILING_S.get(name, 0.0) for name, seconds in stages.items()}
        if ROUNDS not in stages and "fit to slices" in stages:
            stages["fit to slices"] += COMPILING_FIT_S  # otherwise a round of poses and volume has compiled it
    if options.time_budget:
        shorter = max(options.time_budget, 1.0) / sum(stages.values())
        stages = {name: seconds * shorter for name, seconds in stages.items()}
    return stages


class TimeLeft:
    """Share of a run that is done, and the seconds that are left.

    An unexpected stage takes no share. The share never falls.

    Args:
        expected_s: seconds of each stage, in their order.
        clock: gives monotonic seconds.
    """

    def __init__(self, expected_s: Mapping[str, float], clock: Callable[[], float] = time.monotonic) -> None:
        self.expected_s = dict(expected_s)
        self.clock = clock
        self.begun_s = clock()
        self._stage, self._stage_begun_s = "", self.begun_s
        self._steps = (0, 0)
        self._before_s = 0.0
        self._pace = 1.0
        self._shown = 0.0

    @property
    def passed_s(self) -> float:
        """Seconds since the beginning."""
        return self.clock() - self.begun_s

    def begun(self, stage: str) -> None:
        """A stage begins; all earlier stages count as done, whether or not they took place."""
        self._stage, self._stage_begun_s, self._steps = stage, self.clock(), (0, 0)
        self._pace = self._measured_pace(self._before_s)
        if stage in self.expected_s:
            names = list(self.expected_s)
            self._before_s = sum(self.expected_s[name] for name in names[: names.index(stage)])

    def progress(self, done: int, total: int) -> None:
        """Report steps of the present stage: done, and in all."""
        self._steps = (done, total)

    def ended(self, stage: str) -> None:
        """A stage has ended."""
        self.begun(stage)
        self._before_s += self.expected_s.get(stage, 0.0)
        self._stage = ""

    def share(self) -> float:
        """Done share of the whole run, from 0 to 1."""
        total_s = sum(self.expected_s.values())
        self._shown = max(self._shown, min(self._done_s() / total_s, 1.0)) if total_s > 0 else 1.0
        return self._shown

    def left_s(self) -> float:
        """Estimated seconds until the end."""
        done_s = self._done_s()
        return max(0.0, self._measured_pace(done_s) * (sum(self.expected_s.values()) - done_s))

    def _measured_pace(self, done_s: float) -> float:
        """Measured seconds per expected second."""
        return (self.passed_s + STEADY_S) / (done_s + STEADY_S)

    def _done_s(self) -> float:
        """Expected seconds of the part that is done."""
        expected_s = self.expected_s.get(self._stage, 0.0)
        if not expected_s:
            return self._before_s
        done, total = self._steps
        share = done / total if total else 0.0
        if total < MANY_STEPS:
            share = max(share, _by_the_clock((self.clock() - self._stage_begun_s) / (expected_s * self._pace)))
        return self._before_s + min(share, NEARLY) * expected_s


def _by_the_clock(passed: float) -> float:
    """Share of a stage by its seconds over the expected ones: linear up to `EVEN`, ever slower after it."""
    return passed if passed < EVEN else 1 - (1 - EVEN) ** 2 / (passed + 1 - 2 * EVEN)
