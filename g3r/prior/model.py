"""A trained prior: the network, its voxel size and conventions, and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.coarse_volume import DENSITY_CONVENTION, INTENSITY_CONVENTION
from g3r.acquisition.least_squares import SHARP_CONVENTION
from g3r.checkpoints.plain_values import number, numbers
from g3r.checkpoints.trained_model import TrainedModel
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inference import estimate_prior
from g3r.prior.maps import DEFAULT_TILING, EstimatedPrior, PriorMaps, Tiling

VOXEL_MM_RANGE = (0.1, 10.0)
VOXEL_MM_TOLERANCE = 1e-3
"""Voxel sizes that differ by less count as equal."""


@dataclass(frozen=True, kw_only=True)
class Prior(TrainedModel):
    """A trained prior network with its voxel size and template ages; see `TrainedModel` for `load`, `save`, `record`.

    Attributes:
        voxel_mm: isotropic voxel size that it was trained at, and is used at.
        weeks: gestational age of each head of the network's template.

    Raises:
        ValueError: the voxel size is out of range, or the number of ages differs from the template's.
    """

    network: DensityGatedPriorNetwork
    voxel_mm: float
    weeks: tuple[float, ...]

    kind: ClassVar = "prior"
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
        if len(self.weeks) != self.network.config.template_shape[0]:
            raise ValueError(f"{len(self.weeks)} ages for a template of {self.network.config.template_shape[0]}")

    @classmethod
    def own_facts(cls, description: Mapping[str, Any]) -> dict[str, Any]:
        """The voxel size and the template's ages."""
        return {"voxel_mm": number(description, "voxel_mm"), "weeks": numbers(description, "weeks")}

    def own_description(self) -> dict[str, Any]:
        """The voxel size and the template's ages."""
        return {"voxel_mm": float(self.voxel_mm), "weeks": [float(week) for week in self.weeks]}

    @staticmethod
    def stored(name: str, value: Tensor) -> Tensor:
        """The template as float16, which is enough for its intensities."""
        return value.half() if name == "template" else value

    @cached_property
    def template(self) -> AtlasTemplate:
        """The atlas template that was fitted to the subjects of the training."""
        config = self.network.config
        return AtlasTemplate(self.network.template.cpu().numpy(), config.template_grid.affine, np.array(self.weeks))

    def in_words(self) -> str:
        """Voxel size and gate, in words."""
        return f"voxels of {self.voxel_mm:g} mm, alpha {self.network.config.alpha:g}"

    def estimate(self, maps: PriorMaps, *, n_views: int = 1, tiling: Tiling = DEFAULT_TILING) -> EstimatedPrior:
        """Return V_prior for a whole volume of `voxel_mm`; see `estimate_prior`.

        Args:
            maps: intensities divided by their `normalisation_scale`.
            n_views: mirror images over which the prior is averaged, 1 to 8.
            tiling: how large volumes are cut into tiles.

        Raises:
            ValueError: a volume that the network needs is missing, or another number of views.
            NumericalError: the result is not finite.
        """
        return estimate_prior(self.network, maps, n_views=n_views, tiling=tiling)
