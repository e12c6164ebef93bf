"""How a run reports progress: terminal bar, TensorBoard, or nothing."""

from __future__ import annotations

from collections.abc import Sequence


class Reporter:
    """Receives the progress of a run; this base class ignores it.

    Results of stages are passed unchanged; each reporter words them itself.
    """

    def begun(self, stage: str) -> None:
        """A stage begins."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """Steps of a stage are done.

        Args:
            stage: its name.
            done: steps that are done.
            total: steps in all.
        """

    def ended(self, stage: str, found: object, *, resumed: bool = False) -> None:
        """A stage has ended.

        Args:
            stage: its name.
            found: its result; None if there is nothing to report.
            resumed: whether the result was read from an earlier run.
        """


class Reporters(Reporter):
    """Forwards to several reporters."""

    def __init__(self, reporters: Sequence[Reporter]) -> None:
        self.reporters = tuple(reporters)

    def begun(self, stage: str) -> None:
        """See `Reporter`."""
        for one in self.reporters:
            one.begun(stage)

    def progress(self, stage: str, done: int, total: int) -> None:
        """See `Reporter`."""
        for one in self.reporters:
            one.progress(stage, done, total)

    def ended(self, stage: str, found: object, *, resumed: bool = False) -> None:
        """See `Reporter`."""
        for one in self.reporters:
            one.ended(stage, found, resumed=resumed)
