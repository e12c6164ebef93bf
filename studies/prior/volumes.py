"""Coarse, sharp and prior volume of a simulated subject."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.coverage import brain_share, coverage
from g3r.acquisition.images import Volume
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.mask_votes import foreground
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.smooth_fill import smooth_fill
from g3r.acquisition.template_fit import fit_template
from g3r.evaluation.case import SimulatedCase
from g3r.fitting.prior_volume import KNOWN_DENSITY
from g3r.geometry import VolumeGrid
from g3r.prior.maps import PriorMaps, Tiling
from g3r.prior.model import Prior

MARGIN_MM = 5.0
"""Margin around the slices, as in the reconstruction."""


@dataclass(frozen=True)
class PriorVolumes:
    """Inputs and output of the network, [I, J, K] in normalised intensities.

    Attributes:
        by_name: `V_coarse` (Eq. 6), `V_sharp` and `V_prior` (Eq. 7).
        maps: inputs of the network.
        grid: of all volumes.
        seconds: wall time of each step.
    """

    by_name: dict[str, NDArray[np.float32]]
    maps: PriorMaps
    grid: VolumeGrid
    seconds: dict[str, float]


def slices_at_true_poses(case: SimulatedCase, n_stacks: int) -> Slices:
    """The slices of the first stacks at their true poses, without slices of unknown pose."""
    slices = slices_from_stacks(case.stacks[:n_stacks])
    row_of = {key: row for row, key in enumerate(case.true.keys)}
    keys = list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
    known = np.flatnonzero([key in row_of for key in keys])
    slices = slices.take(known)
    rows = np.array([row_of[keys[n]] for n in known])
    return slices.with_pose(case.true.pose.take(rows) @ slices.header_pose)


def template_at_truth(template: AtlasTemplate, truth: Volume, mask: NDArray[np.bool_]) -> PlacedHead:
    """The template of the most similar size, scaled to the volume of the true head and placed at its centre.

    Slices at their true poses are in the frame of the truth, which has the axes of the atlas frame.

    Args:
        template: of a `Prior`.
        truth: the volume that was sliced.
        mask: [I, J, K] of the truth.
    """
    here_mm3 = mask.sum() * truth.grid.voxel_volume_mm3
    there_mm3 = (template.volume > 0).sum((1, 2, 3)) * template.grid.voxel_volume_mm3
    nearest = int(np.abs(np.log(there_mm3 / here_mm3)).argmin())
    placed = template.scaled_head(float(template.weeks[nearest]), float(np.cbrt(here_mm3 / there_mm3[nearest])))
    affine = placed.grid.affine.copy()
    center_mm = truth.grid.world(np.argwhere(mask)).mean(0)
    affine[:3, 3] += center_mm - placed.center_mm
    return PlacedHead(placed.volume, VolumeGrid(placed.grid.shape, affine), center_mm)


def prior_volumes(prior: Prior, slices: Slices, placed: PlacedHead | None, n_views: int = 1) -> PriorVolumes:
    """V_coarse, M_rho, V_sharp and V_prior of slices in their given poses.

    Args:
        prior: network and voxel size.
        slices: posed.
        placed: the prior's template at the head; None takes the smooth continuation instead.
        n_views: see `estimate_prior`.
    """
    seconds: dict[str, float] = {}
    grid = grid_around(slices, prior.voxel_mm, margin_mm=MARGIN_MM)
    coarse, masked = _timed(seconds, "V_coarse", lambda: coarse_and_density(slices, grid))
    sharp = _timed(seconds, "V_sharp", lambda: sharpened_volume(slices, grid, coarse))
    scale = np.float32(normalisation_scale(coarse, masked))
    coarse, sharp, density = coarse / scale, sharp / scale, coverage(slices, grid)
    share = brain_share(masked, density)
    if placed is None:
        known = np.clip(density / KNOWN_DENSITY, 0, 1)
        template, outline = smooth_fill(sharp, known), foreground(slices, grid).mask().astype(np.float32)
    else:
        fitted = _timed(seconds, "template", lambda: fit_template(placed, sharp, share, density, grid))
        template, outline = fitted.values, fitted.inside
    maps = PriorMaps(coarse=coarse, density=density, share=share, sharp=sharp, template=template, outline=outline)
    values = _timed(seconds, "V_prior", lambda: prior.estimate(maps, n_views=n_views)).volume
    return PriorVolumes({"V_coarse": coarse, "V_sharp": sharp, "V_prior": values}, maps, grid, seconds)


def tiling_difference(prior: Prior, volumes: PriorVolumes, tile_voxels: int) -> float:
    """Largest difference, in normalised intensities, between a prior (one view) computed whole and in tiles.

    Args:
        prior: the network.
        volumes: computed whole.
        tile_voxels: edge of a tile.
    """
    tiled = prior.estimate(volumes.maps, tiling=Tiling(0, tile_voxels)).volume
    return float(np.abs(tiled - volumes.by_name["V_prior"]).max())


def _timed(seconds: dict[str, float], name: str, call: Callable[[], Any]) -> Any:
    start = time.perf_counter()
    result = call()
    seconds[name] = time.perf_counter() - start
    return result
