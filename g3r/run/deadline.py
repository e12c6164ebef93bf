"""Length of loops: they run for a number of steps, until a deadline, or until a stop is requested."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace


def _nobody() -> bool:
    return False


@dataclass
class LoopRecord:
    """Step fractions of the timed loops of a run, in order, so that a later run can replay them.

    Attributes:
        loops: for each loop the fractions of its steps (see `timed_steps`).
        repeating: whether the loops are replayed rather than recorded.
    """

    loops: list[list[float]] = field(default_factory=list)
    repeating: bool = False
    _next: int = 0

    def begin(self) -> list[float]:
        """The fractions of the next loop: as recorded, or an empty list to fill."""
        if self.repeating:
            self._next += 1
            return self.loops[self._next - 1] if self._next <= len(self.loops) else []
        self.loops.append([])
        return self.loops[-1]


@dataclass(frozen=True)
class Deadline:
    """A moment by which something has to end.

    Args:
        end_s: time of `clock`; infinity for no deadline.
        clock: gives monotonic seconds.
        is_stopped: whether a stop is requested, whatever the clock says.
        loop_record: records the step fractions so that a later run can replay them; None records nothing.
    """

    end_s: float = math.inf
    clock: Callable[[], float] = field(default=time.monotonic, repr=False)
    is_stopped: Callable[[], bool] = field(default=_nobody, repr=False)
    loop_record: LoopRecord | None = field(default=None, repr=False)

    @classmethod
    def after(cls, seconds: float, clock: Callable[[], float] = time.monotonic) -> Deadline:
        """A deadline in `seconds` from now."""
        return cls(clock() + seconds, clock)

    @property
    def remaining_s(self) -> float:
        """Seconds left; negative when it has passed."""
        return self.end_s - self.clock()

    def part(self, share: float, reserve_s: float = 0.0) -> Deadline:
        """The deadline of a stage that may take a share of the time left after a reserve."""
        return replace(self, end_s=self.clock() + share * max(0.0, self.remaining_s - reserve_s))

    def record_whether_passed(self) -> bool:
        """Whether no time is left by the clock, kept in the loop record; as kept there if loops are replayed."""
        if self.loop_record is None:
            return self.remaining_s <= 0
        known = self.loop_record.begin()
        if not self.loop_record.repeating:
            known.append(float(self.remaining_s <= 0))
        return bool(known and known[0])


def timed_steps(n_steps: int, deadline: Deadline | None = None, least: int = 1) -> Iterator[tuple[int, float]]:
    """Step numbers of a loop, each with the fraction of the loop that is done before it, from 0 to below 1.

    With a deadline, the number of steps that fit is estimated from the mean time per step so far, so that a schedule
    that follows the fraction reaches its end in any case. The fraction never falls.

    Args:
        n_steps: largest number of steps.
        deadline: no step begins that would probably end after it, or once a stop is requested; None runs all steps.
        least: steps that run even after the deadline, but not once a stop is requested.
    """
    if deadline is None:
        for step in range(n_steps):
            yield step, step / n_steps
        return
    written = deadline.loop_record.begin() if deadline.loop_record else []
    steps = _by_the_clock(n_steps, deadline, least)
    if deadline.loop_record and deadline.loop_record.repeating:
        steps = enumerate(written)
    for step, fraction in steps:
        if deadline.is_stopped():
            return
        if deadline.loop_record and not deadline.loop_record.repeating:
            written.append(fraction)
        yield step, fraction


def _by_the_clock(n_steps: int, deadline: Deadline, least: int) -> Iterator[tuple[int, float]]:
    begun, fraction = deadline.clock(), 0.0
    for step in range(n_steps):
        total = n_steps
        if step:
            per_step = (deadline.clock() - begun) / step
            fitting = deadline.remaining_s / per_step if per_step > 0 else n_steps
            if fitting < 1 and step >= least:
                return
            total = max(least, step + int(min(fitting, n_steps)), step + 1)
        fraction = max(fraction, step / min(n_steps, total))
        yield step, fraction
