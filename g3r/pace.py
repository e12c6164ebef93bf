"""How long loops go on: for so many steps, or until a deadline, whichever comes first."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Deadline:
    """A moment by which something has to end.

    Args:
        end_s: on the clock.
        clock: seconds that only go forwards.
    """

    end_s: float
    clock: Callable[[], float] = field(default=time.monotonic, repr=False)

    @classmethod
    def after(cls, seconds: float, clock: Callable[[], float] = time.monotonic) -> Deadline:
        """A deadline so many seconds from now."""
        return cls(clock() + seconds, clock)

    @property
    def remaining_s(self) -> float:
        """Seconds left; negative when it has passed."""
        return self.end_s - self.clock()

    def part(self, share: float, reserve_s: float = 0.0) -> Deadline:
        """The deadline of a stage that may take a share of what is left but for a reserve."""
        return Deadline(self.clock() + share * max(0.0, self.remaining_s - reserve_s), self.clock)


def paced(n_steps: int, deadline: Deadline | None = None, least: int = 1) -> Iterator[tuple[int, float]]:
    """Numbers of steps, and the fraction of the whole that is done before each, from 0 to below 1.

    With a deadline the whole is what fits into the time left, as the steps so far suggest, so that a schedule
    that follows the fraction runs to its end in any case. The fraction never falls.

    Args:
        n_steps: at most so many.
        deadline: no step begins that would probably end after it; None gives all steps.
        least: so many steps are made even then.
    """
    if deadline is None:
        for step in range(n_steps):
            yield step, step / n_steps
        return
    begun, fraction = deadline.clock(), 0.0
    for step in range(n_steps):
        total = n_steps
        if step:
            per_step = (deadline.clock() - begun) / step
            fitting = deadline.remaining_s / per_step if per_step > 0 else n_steps
            if fitting < 1 and step >= least:
                return
            total = min(n_steps, max(least, step + int(fitting), step + 1))
        fraction = max(fraction, step / total)
        yield step, fraction
