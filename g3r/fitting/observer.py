"""Who may look on while a fit runs."""

from __future__ import annotations

from typing import Protocol

from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose


class FitObserver(Protocol):
    """Watches a fit from outside; the time that it takes is its own affair to leave out."""

    every: int
    """Steps between two calls; the last step always has one."""

    def __call__(self, step: int, cloud: GaussianCloud, pose: RigidPose) -> None:
        """Called after `step` steps with the detached cloud and the slices' poses of that moment."""
