"""The arguments of the pose network, shared by its constructor, its training and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass

from g3r.geometry import VolumeGrid

MAX_SHAPE, MAX_SPACING_MM = 1024, 100.0
MAX_CHANNELS, MAX_WIDTH, MAX_BLOCKS, MAX_REFINEMENTS = 4096, 8192, 64, 16
"""Limits beyond which a network takes minutes to build."""


@dataclass(frozen=True, kw_only=True)
class PoseNetworkConfig:
    """Arguments of `PoseNetwork`.

    Args:
        template_shape: [A, I, J, K] of the atlas template: A ages on one grid. Training replaces it by its data's.
        template_spacing_mm: the template's voxel size.
        image_size: N, pixels per edge of a slice image; a multiple of 8.
        pixel_mm: pixel size of the slice image.
        channels: feature channels of the encoder, at 1/2, 1/4 and 1/8 resolution.
        width: width of a token; a multiple of `n_heads`.
        n_blocks: transformer blocks per step.
        n_heads: attention heads.
        n_refinements: default number of refinements, which share their weights. Training draws the number, and
            `poses_of` makes `N_REFINEMENTS`.

    Raises:
        ValueError: a value out of range.
    """

    template_shape: tuple[int, ...] = (1, 2, 2, 2)
    template_spacing_mm: float = 3.0
    image_size: int = 40
    pixel_mm: float = 3.0
    channels: tuple[int, ...] = (24, 48, 96)
    width: int = 128
    n_blocks: int = 3
    n_heads: int = 4
    n_refinements: int = 1

    def __post_init__(self) -> None:
        right = len(self.template_shape) == 4 and all(1 <= n <= MAX_SHAPE for n in self.template_shape)
        right &= all(0 < mm <= MAX_SPACING_MM for mm in (self.template_spacing_mm, self.pixel_mm))
        right &= 8 <= self.image_size <= MAX_SHAPE and self.image_size % 8 == 0
        right &= len(self.channels) == 3 and all(1 <= n <= MAX_CHANNELS for n in self.channels)
        right &= 1 <= self.n_heads <= self.width <= MAX_WIDTH and self.width % self.n_heads == 0
        right &= 1 <= self.n_blocks <= MAX_BLOCKS and 1 <= self.n_refinements <= MAX_REFINEMENTS
        if not right:
            raise ValueError(f"no pose network has these arguments: {self}")

    @property
    def template_grid(self) -> VolumeGrid:
        """The template's grid, centred on the origin of the atlas frame."""
        return VolumeGrid.centred(self.template_shape[1:], self.template_spacing_mm)

    def min_values(self) -> float:
        """A lower bound on the number of the network's weights: template, token layers, units and blocks."""
        token = self.channels[-1] * (self.image_size // 8) ** 2 * self.width
        units = 9 * sum(n**2 for n in self.channels[1:])
        return math.prod(self.template_shape) + 2 * (token + units + 4 * self.n_blocks * self.width**2)
