"""A trained prior: the network, the voxels and conventions that it was trained under, and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.coarse_volume import DENSITY_CONVENTION, INTENSITY_CONVENTION
from g3r.acquisition.least_squares import SHARP_CONVENTION
from g3r.checkpoints.plain_values import number
from g3r.checkpoints.trained_model import TrainedModel
from g3r.checkpoints.weights_file import SHIPPED_PRIOR
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inference import DEFAULT_TILING, Tiling, estimate_prior

VOXEL_MM_RANGE = (0.1, 10.0)
VOXEL_MM_TOLERANCE = 1e-3
"""Voxel sizes that differ by less are the same."""


@dataclass(frozen=True, kw_only=True)
class Prior(TrainedModel):
    """A prior network with what has to be known to use it. See `TrainedModel` for `load`, `save` and `record`.

    Attributes:
        voxel_mm: isotropic voxel size that it was trained at, and is used at.

    Raises:
        ValueError: a voxel size out of range.
    """

    network: DensityGatedPriorNetwork
    voxel_mm: float

    kind: ClassVar = "prior"
    shipped: ClassVar = SHIPPED_PRIOR
    config_type: ClassVar = PriorNetworkConfig
    network_type: ClassVar = DensityGatedPriorNetwork
    conventions: ClassVar = {
        "density_convention": DENSITY_CONVENTION,
        "intensity_convention": INTENSITY_CONVENTION,
        "sharp_convention": SHARP_CONVENTION,
    }

    def __post_init__(self) -> None:
        low, high = VOXEL_MM_RANGE
        if not (math.isfinite(self.voxel_mm) and low <= self.voxel_mm <= high):
            raise ValueError(f"voxel size is {self.voxel_mm} mm; expected {low} to {high} mm")

    @classmethod
    def own_facts(cls, description: Mapping[str, Any]) -> dict[str, Any]:
        """The voxel size."""
        return {"voxel_mm": number(description, "voxel_mm")}

    def own_description(self) -> dict[str, Any]:
        """The voxel size."""
        return {"voxel_mm": float(self.voxel_mm)}

    def in_words(self) -> str:
        """Voxel size and gate."""
        return f"voxels of {self.voxel_mm:g} mm, alpha {self.network.config.alpha:g}"

    def estimate(
        self,
        v_coarse: NDArray[np.float32],
        m_rho: NDArray[np.float32],
        v_sharp: NDArray[np.float32] | None = None,
        *,
        n_views: int = 1,
        tiling: Tiling = DEFAULT_TILING,
    ) -> NDArray[np.float32]:
        """Return V_prior for a whole volume of `voxel_mm`, float32 [I, J, K]; see `estimate_prior`.

        Args:
            v_coarse: [I, J, K], divided by its `normalisation_scale`.
            m_rho: [I, J, K], dimensionless density M >= 0.
            v_sharp: [I, J, K], on V_coarse's scale.
            n_views: mirror images over which the prior is averaged, 1 to 8.
            tiling: how large volumes are cut.

        Raises:
            ValueError: volumes that do not fit together, or another number of views.
            NumericalError: the result is not finite.
        """
        return estimate_prior(self.network, v_coarse, m_rho, v_sharp, n_views=n_views, tiling=tiling)
