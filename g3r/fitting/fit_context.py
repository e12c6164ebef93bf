"""Context of a fit: random numbers, progress, deadline and observer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from g3r.fitting.observer import FitObserver
from g3r.run.deadline import Deadline
from g3r.run.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True)
class FitContext:
    """What a fit is given beside its model and its data.

    Args:
        rng: draws the planes of a volume.
        progress: called with (steps done, steps in all).
        deadline: fewer steps if they would end after it; schedules still run to their ends. None runs all steps.
        observer: called at steps of the fit; None calls nobody.
    """

    rng: np.random.Generator
    progress: Progress = no_progress
    deadline: Deadline | None = None
    observer: FitObserver | None = None
