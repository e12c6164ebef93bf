"""Stop requests by Ctrl-C and SIGTERM: obeyed at once, or at the next step if there is something worth keeping."""

from __future__ import annotations

import signal
from dataclasses import replace
from types import FrameType, TracebackType

from g3r.run.deadline import Deadline

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Handles SIGINT and SIGTERM, as a context manager.

    A first signal raises `KeyboardInterrupt` immediately until `postpone` is called; from then on it only sets
    `is_requested`, which loops check. A second signal always raises.

    Kernels are never interrupted, because Python handles signals between two of its own instructions.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._postponed = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> StopRequest:
        for number in SIGNALS:
            try:
                self._before[number] = signal.signal(number, self._heard)
            except ValueError:  # only the main thread may handle signals
                break
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def is_requested(self) -> bool:
        """Whether a stop was requested."""
        return self.signal is not None

    def postpone(self) -> None:
        """From now on let a first signal wait for the current step, because there is something to keep."""
        self._postponed = True

    def with_deadline(self, deadline: Deadline | None) -> Deadline:
        """A deadline that also passes when a stop is requested."""
        return replace(deadline or Deadline(), is_stopped=self.is_requested)

    @property
    def exit_code(self) -> int:
        """Exit code as in shells: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + (self.signal or signal.SIGINT)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        first, self.signal = self.signal is None, number
        if not (first and self._postponed):
            raise KeyboardInterrupt
