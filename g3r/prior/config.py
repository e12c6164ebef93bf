"""The arguments of the prior network, shared by its constructor, its training and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass

from g3r.geometry import VolumeGrid

MAX_LEVELS = 16
MAX_CHANNELS = 4096
MAX_UNITS = 64
"""Limits beyond which a network takes minutes to build."""

MAX_TEMPLATE_EDGE = 512
MAX_SPACING_MM = 100.0


@dataclass(frozen=True, kw_only=True)
class PriorNetworkConfig:
    """Arguments of `DensityGatedPriorNetwork`.

    Args:
        channels: feature channels of F at 1/2, 1/4, ... resolution; at least one level. Multiples of 16 are
            fastest on CPUs with 512-bit vectors.
        units: residual units (two 3x3x3 convolutions each) per level and direction; one number per level.
        tail_channels: feature channels of F at full resolution.
        alpha: gate at high density; the paper's value is the default.
        beta: gate at zero density; the paper's value is the default.
        use_gate: False sets G = 1 everywhere (an ablation).
        use_density: False hides the densities from F (an ablation); gate and base still use the coverage.
        use_sharp: True shows V_sharp to F, in addition to V_coarse; False is Eq. 7 as printed.
        sharp_base: True adds the residual to V_sharp instead of V_coarse (an ablation).
        use_template: True shows the fitted template to F, and uses it as the base where no slice looked.
        template_shape: [A, I, J, K] of the atlas template: A ages on one grid. Training replaces it by its data's.
        template_spacing_mm: the template's voxel size.

    Raises:
        ValueError: no level, different numbers of levels, a count out of range, or `sharp_base` without `use_sharp`.
    """

    channels: tuple[int, ...] = (32, 64, 96)
    units: tuple[int, ...] = (1, 2, 3)
    tail_channels: int = 8
    alpha: float = 0.05
    beta: float = 1.0
    use_gate: bool = True
    use_density: bool = True
    use_sharp: bool = True
    sharp_base: bool = False
    use_template: bool = True
    template_shape: tuple[int, ...] = (1, 2, 2, 2)
    template_spacing_mm: float = 1.6

    def __post_init__(self) -> None:
        limited = [(n, MAX_CHANNELS) for n in (*self.channels, self.tail_channels)]
        limited += [(n, MAX_UNITS) for n in self.units]
        if not 1 <= len(self.channels) == len(self.units) <= MAX_LEVELS or not all(1 <= n <= m for n, m in limited):
            raise ValueError(
                f"a prior network needs one positive entry per level, at most {MAX_CHANNELS} channels and {MAX_UNITS} "
                f"units; got {self.channels}, {self.units}, tail {self.tail_channels}"
            )
        if self.sharp_base and not self.use_sharp:
            raise ValueError("sharp_base needs use_sharp")
        right = len(self.template_shape) == 4 and all(1 <= n <= MAX_TEMPLATE_EDGE for n in self.template_shape)
        if not right or not 0 < self.template_spacing_mm <= MAX_SPACING_MM:
            raise ValueError(f"template of {self.template_shape} voxels of {self.template_spacing_mm} mm")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Volumes that F sees, in order: V_coarse, and optionally two confidences, V_sharp and the template."""
        used = {
            "coarse": True,
            "confidence in the brain": self.use_density,
            "sharp": self.use_sharp,
            "confidence": self.use_density,
            "template": self.use_template,
        }
        return tuple(name for name, is_used in used.items() if is_used)

    @property
    def n_inputs(self) -> int:
        """Number of volumes that F sees."""
        return len(self.inputs)

    @property
    def template_grid(self) -> VolumeGrid:
        """The template's grid, centred on the origin of the atlas frame."""
        return VolumeGrid.centred(self.template_shape[1:], self.template_spacing_mm)

    @property
    def stride(self) -> int:
        """Voxels of the input per voxel of the deepest level, along each axis."""
        return 2 ** len(self.channels)

    def min_values(self) -> float:
        """A lower bound on the number of the network's weights: its template, its residual units and its tail."""
        levels = zip(self.channels, self.units, strict=True)
        return math.prod(self.template_shape) + 27 * (
            sum(2 * n * width**2 for width, n in levels) + self.tail_channels**2
        )
