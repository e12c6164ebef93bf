"""The arguments of the mask network, shared by its constructor, its training and its file."""

from __future__ import annotations

from dataclasses import dataclass

MAX_CHANNELS, MAX_LEVELS = 1024, 6
"""Limits beyond which a network takes minutes to build."""
MAX_SPACING_MM = 100.0


@dataclass(frozen=True, kw_only=True)
class MaskNetworkConfig:
    """Arguments of `MaskNetwork`.

    Args:
        wide_mm: pixel size at which a head is searched for in the whole stack.
        pixel_mm: pixel size at which it is outlined; slices are resampled in the plane only, in both steps.
        channels: feature channels of the levels, at 2, 4, 8, ... times the pixel size.

    Raises:
        ValueError: a value out of range.
    """

    wide_mm: float = 2.4
    pixel_mm: float = 1.2
    channels: tuple[int, ...] = (24, 48, 96, 128)

    def __post_init__(self) -> None:
        right = all(0 < mm <= MAX_SPACING_MM for mm in (self.wide_mm, self.pixel_mm))
        right &= 1 <= len(self.channels) <= MAX_LEVELS and all(1 <= n <= MAX_CHANNELS for n in self.channels)
        if not right:
            raise ValueError(f"no mask network has these arguments: {self}")

    def min_values(self) -> float:
        """A lower bound on the number of the network's weights: the second convolution of each level."""
        return 9 * sum(n**2 for n in self.channels)
