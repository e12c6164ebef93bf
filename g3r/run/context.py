"""Context of a run: stage store, clock, stop request, reporter, notes and warnings."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

from g3r.run.clock import Clock
from g3r.run.deadline import Deadline
from g3r.run.progress import Progress
from g3r.run.reporter import Reporter
from g3r.run.stage_store import StageStore
from g3r.run.stop_request import StopRequest

logger = logging.getLogger(__name__)

Result = TypeVar("Result")


@dataclass(frozen=True)
class StoppedAt:
    """Where a stop request ended a run."""

    stage: str
    step: int
    n_steps: int

    def __str__(self) -> str:
        return f"interrupted in {self.stage}, step {self.step} of {self.n_steps}"


@dataclass(kw_only=True)
class RunContext:
    """Runs the stages of one computation: times them, stores their results, and ends early on a stop request.

    A stop request before the first droppable or stoppable stage raises `KeyboardInterrupt`. Afterwards it
    sets `stopped_at`, and the caller builds its result from the stages that are done.

    Args:
        store: stores results of stages, or supplies those of an earlier run; by default nothing is stored.
        stop_request: signals that end the run early; None leaves them alone.
        reporter: is notified when stages begin, progress and end, with their results.
        clock: seconds of each stage.
        notes: remarks for the record.
        warnings: about the result; logged when the result is made.
        stopped_at: where a stop request ended the run; None if none did.
    """

    store: StageStore = field(default_factory=StageStore)
    stop_request: StopRequest | None = None
    reporter: Reporter = field(default_factory=Reporter)
    clock: Clock = field(default_factory=Clock)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    stopped_at: StoppedAt | None = None
    _position: StoppedAt | None = field(default=None, init=False)

    def stage(self, name: str, make: Callable[[], Result]) -> Result:
        """Result of a stage: from the store if an earlier run finished it, else computed, timed and stored."""
        return self._run(name, make)

    def droppable_stage(self, name: str, make: Callable[[], Result]) -> Result | None:
        """Result of a stage that a first stop request ends at once.

        Returns:
            The result; None if the stage was stopped.
        """
        try:
            return self._run(name, make)
        except KeyboardInterrupt:
            if not self._stop_is_requested():
                raise
            self.postpone_stop()
            at = self._position
            self.stopped_at = at if at and at.stage == name else StoppedAt(str(name), 0, 0)
            return None

    def stoppable_stage(
        self, name: str, make: Callable[[], Result], steps_of: Callable[[Result], tuple[int, int]]
    ) -> Result | None:
        """Result of a stage whose loop ends after the current step on a stop request; it is not stored then.

        Args:
            name: name of the stage.
            make: computes it; its loop obeys a deadline from `deadline`.
            steps_of: (steps done, steps in all) of a result.

        Returns:
            The result; None if the run was stopped before this stage.
        """
        if self.stopped_at is not None:
            return None
        self.postpone_stop()
        result = self._run(name, make, keep=lambda: not self._stop_is_requested())
        if self._stop_is_requested():
            self.stopped_at = StoppedAt(str(name), *steps_of(result))
        return result

    @contextmanager
    def timed(self, name: str) -> Iterator[Callable[[object], None]]:
        """Run the block as a stage that is not stored; yields a function that takes the result to report."""
        told: list[object] = []
        self.reporter.begun(name)
        with self.clock(name):
            yield told.append
        self.reporter.ended(name, told[-1] if told else None)

    def deadline(self, deadline: Deadline | None) -> Deadline | None:
        """A deadline that also passes on a stop request; None if there is neither."""
        return deadline if self.stop_request is None else self.stop_request.with_deadline(deadline)

    def postpone_stop(self) -> None:
        """From now on let a first signal only set the stop request, because there is something worth keeping."""
        if self.stop_request is not None:
            self.stop_request.postpone()

    def report(self, stage: str) -> Progress:
        """The progress function (steps done, steps in all) of one stage."""

        def report(done: int, total: int) -> None:
            self._position = StoppedAt(str(stage), done, total)
            self.reporter.progress(stage, done, total)

        return report

    def _run(self, name: str, make: Callable[[], Result], keep: Callable[[], bool] = lambda: True) -> Result:
        self._position = None
        found = self.store.read(name)
        if found is not None:
            self.clock.add(name, found.seconds, found.cpu_seconds)
            self.reporter.ended(name, found.value, resumed=True)
            return found.value
        self.reporter.begun(name)
        with self.clock(name):
            value = make()
        value = self.store.as_stored(value)
        if keep():
            self.store.write(name, value, self.clock.seconds[name], self.clock.cpu_seconds[name])
        self.reporter.ended(name, value)
        return value

    def _stop_is_requested(self) -> bool:
        return self.stop_request is not None and self.stop_request.is_requested()
