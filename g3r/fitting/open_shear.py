"""The open shear of the head, which slices of two orientations do not determine, as a parameter of a fit.

Let n and m be the normals of two stacks and E a multiple of n m^T + m n^T. The motion x -> x + a E x of the head keeps
every slice of either stack a rigid plane, to first order: E has no component within a slice, since one of its two
factors is zero there. Slices shift along the other normal and tilt. So Gaussians and slices that move by it together
explain the same pixels, except where slices are turned against others of their stack. Steps of single slices are slow
to find it, since a slice that moves alone leaves the volume that the others made. Before it was a parameter, it was
most of the error that was left with two stacks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.orientations import mean_normals
from g3r.acquisition.planes import Slices
from g3r.fitting.parameters import FitParameters
from g3r.registration.open_strain import open_strain


@dataclass(frozen=True, kw_only=True)
class OpenShear:
    """How Gaussians and slices move together per unit of the shear.

    Attributes:
        strain: [3, 3] symmetric, of Frobenius norm 1.
        middle_mm: [3] the point that stays in place, from the cloud's origin.
        rotation: [K, 3] rad, applied after the rotation of each slice.
        translation_mm: [K, 3].
    """

    strain: NDArray[np.float64]
    middle_mm: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    @classmethod
    def of(cls, slices: Slices, origin_mm: NDArray[np.float64]) -> OpenShear | None:
        """The open shear of some slices; None unless exactly one strain is open.

        Args:
            slices: K slices at the start of a fit.
            origin_mm: [3] of the cloud.
        """
        strain = open_strain(mean_normals(slices))
        if strain is None:
            return None
        frame, center_mm = slices.planes.rotation, slices.planes.center_mm - origin_mm
        middle_mm = center_mm.mean(0)
        within = np.einsum("kji,jl,klm->kim", frame, strain, frame)
        return cls(
            strain=strain,
            middle_mm=middle_mm,
            rotation=np.stack([within[:, 2, 1], -within[:, 2, 0], np.zeros(len(slices))], axis=1),
            translation_mm=(center_mm - middle_mm) @ strain,
        )

    def slope(self, parameters: FitParameters) -> float:
        """The derivative of the loss by the shear.

        Args:
            parameters: with the gradients of `mean_mm`, `rotation` and `translation`.
        """
        gradient = parameters.gradient
        along = np.vdot(gradient["mean_mm"].astype(np.float64), self._of_centres(parameters))
        along += np.vdot(gradient["rotation"].astype(np.float64), self.rotation)
        return float(along + np.vdot(gradient["translation"].astype(np.float64), self.translation_mm))

    def fold(self, parameters: FitParameters) -> None:
        """Apply the shear that the optimiser has found to Gaussians and slices, and reset it to zero.

        Args:
            parameters: with a block `shear` [1].
        """
        value = parameters.value
        amount = float(value["shear"][0])
        value["shear"][0] = 0.0
        value["mean_mm"] += (amount * self._of_centres(parameters)).astype(np.float32)
        value["rotation"] += (amount * self.rotation).astype(np.float32)
        value["translation"] += (amount * self.translation_mm).astype(np.float32)

    def _of_centres(self, parameters: FitParameters) -> NDArray[np.float64]:
        return np.asarray((parameters.value["mean_mm"].astype(np.float64) - self.middle_mm) @ self.strain)
