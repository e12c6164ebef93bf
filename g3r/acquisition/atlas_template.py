"""Atlas templates: mean heads in standard orientation, with which slices of an unknown head are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.geometry import VolumeGrid


@dataclass(frozen=True)
class PlacedHead:
    """One head of an atlas template where it lies in space.

    Args:
        volume: [I, J, K] float32, zero outside the brain.
        grid: its grid.
        center_mm: [3] of the head.
    """

    volume: NDArray[np.float32]
    grid: VolumeGrid
    center_mm: NDArray[np.float64]

    @classmethod
    def of(cls, volume: NDArray[np.float32], grid: VolumeGrid) -> PlacedHead:
        """A head whose centre is the mean position of its brain.

        Args:
            volume: [I, J, K] float32, zero outside the brain.
            grid: its grid.
        """
        return cls(volume, grid, grid.world(np.argwhere(volume > 0)).mean(0))

    def box_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner of its brain, [3] each."""
        inside = self.grid.world(np.argwhere(self.volume > 0))
        return inside.min(0), inside.max(0)


@dataclass(frozen=True)
class AtlasTemplate:
    """Mean heads by gestational age on one grid, in the atlas frame.

    The atlas frame is RAS in mm with the head's centre at the origin and the mid-sagittal plane at x = 0.

    Args:
        volume: [A, I, J, K] float32; the 99.5th percentile in each head is 1, the background 0.
        affine: [4, 4] RAS+ mm from index.
        weeks: [A] gestational ages.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """

    volume: NDArray[np.float32]
    affine: NDArray[np.float64]
    weeks: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name, dtype in (("volume", np.float32), ("affine", np.float64), ("weeks", np.float64)):
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if not np.isfinite(array).all():
                raise ValueError(f"template: {name} holds values that are not finite")
            object.__setattr__(self, name, array)
        if self.volume.ndim != 4 or self.affine.shape != (4, 4) or self.weeks.shape != self.volume.shape[:1]:
            raise ValueError(
                f"template: volume {self.volume.shape}, affine {self.affine.shape}, weeks "
                f"{self.weeks.shape}; expected [A, I, J, K], [4, 4], [A]"
            )
        if not len(self.volume):
            raise ValueError("template: holds no head")

    def __len__(self) -> int:
        return len(self.volume)

    @property
    def grid(self) -> VolumeGrid:
        """Voxel grid of every head."""
        shape = self.volume.shape
        return VolumeGrid((shape[1], shape[2], shape[3]), self.affine)

    def head(self, number: int) -> PlacedHead:
        """One of the heads, in the atlas frame."""
        return PlacedHead.of(self.volume[number], self.grid)

    def scaled_head(self, weeks: float, scale: float) -> PlacedHead:
        """The head nearest in age, enlarged about its centre.

        Args:
            weeks: the subject's age, as found by registration.
            scale: factor by which a template of that age has to be enlarged.
        """
        head = self.head(int(np.abs(self.weeks - weeks).argmin()))
        return PlacedHead.of(head.volume, head.grid.scaled_about(head.center_mm, scale))
