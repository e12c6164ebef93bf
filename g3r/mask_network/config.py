"""The arguments of the mask networks, as their constructor, their training and their file have them."""

from __future__ import annotations

from dataclasses import dataclass

MAX_CHANNELS, MAX_LEVELS = 1024, 6
"""Beyond these a network takes minutes to build."""
MAX_SPACING_MM = 100.0


@dataclass(frozen=True, kw_only=True)
class MaskNetworkConfig:
    """Arguments of `MaskNetwork`.

    Args:
        coarse_mm: voxel size at which a head is looked for in the whole stack.
        pixel_mm: pixel size at which it is outlined in its slices.
        finder_channels: of the localiser at 2, 4, 8, ... times its voxel size.
        outline_channels: of the outline at 2, 4, 8, ... times its pixel size.

    Raises:
        ValueError: a value out of range.
    """

    coarse_mm: float = 4.0
    pixel_mm: float = 1.2
    finder_channels: tuple[int, ...] = (24, 48, 96)
    outline_channels: tuple[int, ...] = (24, 48, 96, 128)

    def __post_init__(self) -> None:
        both = (self.finder_channels, self.outline_channels)
        right = all(0 < mm <= MAX_SPACING_MM for mm in (self.coarse_mm, self.pixel_mm))
        right &= all(1 <= len(channels) <= MAX_LEVELS for channels in both)
        right &= all(1 <= n <= MAX_CHANNELS for channels in both for n in channels)
        if not right:
            raise ValueError(f"no mask network has these arguments: {self}")

    def min_values(self) -> float:
        """A lower bound on the number of the networks' weights: the second convolution of each level."""
        return 27 * sum(n**2 for n in self.finder_channels) + 9 * sum(n**2 for n in self.outline_channels)
