"""Wall and CPU seconds of each stage of a run."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

logger = logging.getLogger(__name__)


class Clock:
    """Seconds by stage, in the order in which the stages ended.

    Attributes:
        seconds: wall time of each stage.
        cpu_seconds: CPU time of each stage, all threads together.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the block as one stage, and log its seconds when it ends."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.add(stage, round(time.perf_counter() - wall, 3), round(time.process_time() - cpu, 3))
        logger.info("%s: %.1f s", stage, self.seconds[stage])

    def add(self, stage: str, seconds: float, cpu_seconds: float) -> None:
        """Record a stage that was timed elsewhere, such as in an earlier run.

        Args:
            stage: its name.
            seconds: wall-clock time.
            cpu_seconds: processor time of all threads.
        """
        self.seconds[str(stage)] = seconds
        self.cpu_seconds[str(stage)] = cpu_seconds
