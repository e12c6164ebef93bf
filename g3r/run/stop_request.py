"""Ctrl-C and SIGTERM: the end at once, or, once there is something worth keeping, at the next step."""

from __future__ import annotations

import signal
from dataclasses import replace
from types import FrameType, TracebackType

from g3r.run.deadline import Deadline

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Listens to both signals while it is entered.

    The first one raises `KeyboardInterrupt` wherever the program is, until `postpone` is called; from then on
    it only sets `is_requested`, for loops to look at. A second one always raises.

    Kernels are never cut: Python handles signals between two of its own instructions.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._postponed = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> StopRequest:
        for number in SIGNALS:
            try:
                self._before[number] = signal.signal(number, self._heard)
            except ValueError:  # not the main thread: signals are somebody else's affair
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
        """From now on there is something to keep: a first signal lets the present step end."""
        self._postponed = True

    def with_deadline(self, deadline: Deadline | None) -> Deadline:
        """A deadline that also passes when a stop is requested."""
        return replace(deadline or Deadline(), is_stopped=self.is_requested)

    @property
    def exit_code(self) -> int:
        """As shells count: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + (self.signal or signal.SIGINT)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        first, self.signal = self.signal is None, number
        if not (first and self._postponed):
            raise KeyboardInterrupt
