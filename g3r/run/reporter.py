"""Who hears how a run goes on: a bar on a terminal, TensorBoard, or nobody."""

from __future__ import annotations

from collections.abc import Sequence


class Reporter:
    """Is told of the stages of a run; this one tells nobody.

    What a stage found is handed over as it is: words for it are made by whoever hears it.
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
            found: what it gives; None where there is nothing to tell.
            resumed: whether it was taken from an earlier run.
        """


class Reporters(Reporter):
    """Passes everything on to several."""

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
