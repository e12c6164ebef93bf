"""The volumes that lead to a prior (coarse, sharp, prior) of a simulated subject."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.evaluation.case import SimulatedCase
from g3r.geometry import VolumeGrid

if TYPE_CHECKING:
    from g3r.prior.dgpn import DensityGatedPriorNetwork

MARGIN_MM = 5.0
"""Around the slices, as the reconstruction has it."""


@dataclass(frozen=True)
class PriorVolumes:
    """Inputs and output of the network, [I, J, K] in normalised intensities.

    Attributes:
        by_name: `V_coarse` (Eq. 6), `V_sharp` and `V_prior` (Eq. 7).
        density: M_rho.
        grid: of all of them.
        seconds: wall time of each step.
    """

    by_name: dict[str, NDArray[np.float32]]
    density: NDArray[np.float32]
    grid: VolumeGrid
    seconds: dict[str, float]


def slices_at_true_poses(case: SimulatedCase, n_stacks: int) -> Slices:
    """The first stacks' slices where they were truly taken; slices of unknown pose are excluded."""
    slices = slices_from_stacks(case.stacks[:n_stacks])
    row_of = {key: row for row, key in enumerate(case.true.keys)}
    keys = list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
    known = np.flatnonzero([key in row_of for key in keys])
    slices = slices.take(known)
    rows = np.array([row_of[keys[n]] for n in known])
    return slices.with_pose(case.true.pose.take(rows) @ slices.header_pose)


def prior_volumes(network: DensityGatedPriorNetwork, slices: Slices, voxel_mm: float, n_views: int = 1) -> PriorVolumes:
    """V_coarse, M_rho, V_sharp and V_prior of slices in the poses that they have.

    Args:
        network: of a `Prior`.
        slices: posed.
        voxel_mm: that the network was trained on.
        n_views: see `estimate_prior`.
    """
    from g3r.prior.inference import estimate_prior

    seconds: dict[str, float] = {}
    grid = grid_around(slices, voxel_mm, margin_mm=MARGIN_MM)
    coarse, density = _timed(seconds, "V_coarse", lambda: coarse_and_density(slices, grid))
    sharp = _timed(seconds, "V_sharp", lambda: sharpened_volume(slices, grid, coarse))
    scale = np.float32(normalisation_scale(coarse, density))
    given = coarse / scale, density, sharp / scale
    prior = _timed(seconds, "V_prior", lambda: estimate_prior(network, *given, n_views=n_views))
    by_name = {"V_coarse": coarse / scale, "V_sharp": sharp / scale, "V_prior": prior}
    return PriorVolumes(by_name, density, grid, seconds)


def tiling_difference(network: DensityGatedPriorNetwork, volumes: PriorVolumes, tile_voxels: int) -> float:
    """Largest difference, in the normalised scale, between a prior of one view made whole and in tiles.

    Args:
        network: of a `Prior`.
        volumes: made whole.
        tile_voxels: edge of a tile.
    """
    from g3r.prior.inference import Tiling, estimate_prior

    given = volumes.by_name["V_coarse"], volumes.density, volumes.by_name["V_sharp"]
    tiled = estimate_prior(network, *given, tiling=Tiling(0, tile_voxels))
    return float(np.abs(tiled - volumes.by_name["V_prior"]).max())


def _timed(seconds: dict[str, float], name: str, call: Callable[[], Any]) -> Any:
    start = time.perf_counter()
    result = call()
    seconds[name] = time.perf_counter() - start
    return result
