"""Inputs and outputs of the estimation of a prior, without the network and its libraries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tiling:
    """How a large volume is cut into tiles for the network, which needs about 0.12 GB of memory per million voxels.

    Args:
        max_whole_voxels: larger volumes are cut into tiles.
        tile_voxels: edge length of a tile without its halo; rounded up to the network's stride.
        halo_voxels: how far a tile sees beyond its edge; rounded up to the network's stride.

    Raises:
        ValueError: a tile without voxels, or a halo below 0.
    """

    max_whole_voxels: int = 16_000_000
    tile_voxels: int = 160
    halo_voxels: int = 64

    def __post_init__(self) -> None:
        if self.tile_voxels < 1 or self.halo_voxels < 0:
            raise ValueError(f"a tile needs voxels and a halo of at least 0; got {self}")


DEFAULT_TILING = Tiling()


@dataclass(frozen=True, kw_only=True)
class PriorMaps:
    """Volumes [I, J, K] of one grid that a prior is made from; see `PriorInputs`."""

    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    share: NDArray[np.float32] | None = None
    sharp: NDArray[np.float32] | None = None
    template: NDArray[np.float32] | None = None
    outline: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        shape = self.coarse.shape
        wrong = {name: one.shape for name, one in vars(self).items() if one is not None and one.shape != shape}
        if len(shape) != 3 or min(shape) < 1 or wrong:
            raise ValueError(f"expected 3D volumes of one shape; got {shape} and {wrong}")


@dataclass(frozen=True, kw_only=True)
class EstimatedPrior:
    """V_prior and the probability of each voxel being brain, float32 [I, J, K]."""

    volume: NDArray[np.float32]
    brain: NDArray[np.float32]
