"""Observers, which are called with the state of a fit at its steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.fitting.parameters import FitParameters
from g3r.fitting.plane_state import PlaneState
from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose


@dataclass(frozen=True)
class SliceMoment:
    """The slices at one moment of a fit: their present state, and the slices at its start."""

    state: PlaneState
    start: Slices

    def pose(self, origin_mm: NDArray[np.float64]) -> RigidPose:
        """Their poses [K]; `origin_mm` is that of the cloud."""
        return self.state.pose(origin_mm)

    def moved(self, origin_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far each has moved since the fit began: its centre in mm [K], and its angle in degrees [K]."""
        before, now = self.start.planes.pose, self.pose(origin_mm)
        shift = np.linalg.norm(now.translation_mm - before.translation_mm, axis=1)
        turn = (before.inverse() @ now).rotvec_rad()
        return shift, np.rad2deg(np.linalg.norm(turn, axis=1))


@dataclass(frozen=True, kw_only=True)
class FitMoment:
    """A fit after one of its steps; to be read at once, because the optimiser goes on writing into it.

    Attributes:
        step: steps that are done.
        loss: terms of the loss of the last one.
        parameters: of the fit.
        slices: state of the slices; None in the fit to the prior.
    """

    step: int
    loss: Mapping[str, float]
    parameters: FitParameters
    slices: SliceMoment | None = None

    def cloud(self) -> GaussianCloud:
        """A copy of the Gaussians."""
        return self.parameters.cloud()


class FitObserver(Protocol):
    """Called with the state of a fit."""

    every: int
    """Steps between two calls; there is always one at the last step."""

    def __call__(self, moment: FitMoment) -> None:
        """Called when a step is done."""


def is_due(observer: FitObserver | None, step: int, n_steps: int) -> TypeGuard[FitObserver]:
    """Whether an observer is to be called at this step.

    Args:
        observer: None if there is none.
        step: steps that are done.
        n_steps: steps in all.
    """
    return observer is not None and (step % observer.every == 0 or step == n_steps)
