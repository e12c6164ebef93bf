"""State of planes at one step of a fit, at which an image term is evaluated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bias_basis import N_TERMS
from g3r.acquisition.planes import Planes
from g3r.geometry import RigidPose


@dataclass(frozen=True, kw_only=True)
class PlaneState:
    """K planes at one step of a fit.

    Attributes:
        rotation: [K, 3, 3].
        center_mm: [K, 3] from the cloud's origin.
        gain: [K] intensity factors.
        slice_weight: [K].
        coefficients: [K, 5] of the log-intensity fields.
    """

    rotation: NDArray[np.float64]
    center_mm: NDArray[np.float64]
    gain: NDArray[np.float64]
    slice_weight: NDArray[np.float64]
    coefficients: NDArray[np.float32]

    @classmethod
    def of(cls, planes: Planes, origin_mm: NDArray[np.float64]) -> PlaneState:
        """Planes where they are, with gain and weight 1 and no field.

        Args:
            planes: K planes.
            origin_mm: [3] of the cloud.
        """
        n = len(planes)
        return cls(
            rotation=planes.rotation,
            center_mm=planes.center_mm - origin_mm,
            gain=np.ones(n),
            slice_weight=np.ones(n),
            coefficients=np.zeros((n, N_TERMS), np.float32),
        )

    def pose(self, origin_mm: NDArray[np.float64]) -> RigidPose:
        """World from plane, for a cloud with this origin [3]."""
        return RigidPose(self.rotation, self.center_mm + origin_mm)

    def moved_mm(self, then: PlaneState, reach_mm: float) -> float:
        """Bound of how far any Gaussian has moved relative to a plane.

        Args:
            then: the same planes earlier.
            reach_mm: largest distance of a Gaussian from the centre of a plane.
        """
        if self is then or not len(self.rotation):
            return 0.0
        shifted = np.linalg.norm(self.center_mm - then.center_mm, axis=1)
        chord = np.linalg.norm(self.rotation - then.rotation, axis=(1, 2)) / np.sqrt(8)
        angle = 2 * np.arcsin(np.minimum(chord, 1))
        return float((shifted + angle * reach_mm).max())
