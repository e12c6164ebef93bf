"""Start of a fit: normalised slices, and the volumes that posed slices determine without a prior."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.common_bias_field import common_log_field, without_field
from g3r.acquisition.coverage import brain_share
from g3r.acquisition.foreground import Foreground
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.mask_votes import Votes
from g3r.acquisition.planes import Slices
from g3r.geometry import VolumeGrid

MARGIN_MM = 5.0
"""Margin of the prior's grid around the masked pixels."""

CUT_OFF_MM = 6.0
"""How far beyond the masked pixels a head of the template's size must reach to count as cut off there."""


@dataclass(frozen=True, kw_only=True)
class InitialVolumes:
    """Posed slices and the volumes that they give by themselves, in normalised intensities.

    Attributes:
        slices: the given slices, with intensities divided by `scale`.
        coarse: V_coarse [I, J, K] (G3R Eq. 6).
        density: M_rho [I, J, K] (G3R Eq. 6), of whole slices.
        masked_density: [I, J, K], of the masked pixels alone, to which the fit is made.
        sharp: V_sharp [I, J, K], the least-squares volume.
        foreground: state of each voxel by the masks of the slices.
        grid: of all these.
        scale: intensity that slices and volumes were divided by.
        field_rms: root mean square over the brain of the logarithm of the bias field that was divided out of slices
            and volumes; 0 where none was.
    """

    slices: Slices
    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    masked_density: NDArray[np.float32]
    sharp: NDArray[np.float32]
    foreground: Foreground
    grid: VolumeGrid
    scale: float
    field_rms: float = 0.0

    @classmethod
    def of(
        cls,
        slices: Slices,
        gain: NDArray[np.float64],
        weight: NDArray[np.float64],
        voxel_mm: float,
        expected_box_mm: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
        *,
        common_bias_field: bool = True,
    ) -> InitialVolumes:
        """The volumes of slices in their poses.

        Args:
            slices: K slices.
            gain: [K] intensity factors.
            weight: [K] slice weights.
            voxel_mm: voxel size of the grid.
            expected_box_mm: lowest and highest corner [3] of the box in which the whole head is expected; where it goes
                far beyond the masked pixels, so does the grid.
            common_bias_field: whether the bias field that stacks share is estimated and divided out.
        """
        grid = _with_room(grid_around(slices, voxel_mm, margin_mm=MARGIN_MM), expected_box_mm)
        slice_weight = weight[slices.pixel_plane]
        coarse, masked = coarse_and_density(slices, grid, gain, slice_weight)
        sharp = sharpened_volume(slices, grid, coarse, gain, slice_weight)
        votes = Votes.of(slices, grid, weight)
        field_rms = 0.0
        with ThreadPoolExecutor(1) as pool:  # N4 runs on one thread and releases the GIL
            field = pool.submit(common_log_field, sharp, votes.core, grid) if common_bias_field else None
            seen = votes.foreground()
        if field is not None:
            log_field = field.result()
            slices = without_field(slices, log_field, grid)
            coarse, sharp = coarse * np.exp(-log_field), sharp * np.exp(-log_field)
            field_rms = float(np.sqrt((log_field[seen.core] ** 2).mean())) if seen.core.any() else 0.0
        scale = normalisation_scale(coarse, masked)
        slices = slices.scaled(1 / scale)
        coarse, sharp = coarse / np.float32(scale), sharp / np.float32(scale)
        return cls(
            slices=slices,
            coarse=coarse,
            density=votes.density,
            masked_density=masked,
            sharp=sharp,
            foreground=seen,
            grid=grid,
            scale=scale,
            field_rms=field_rms,
        )

    @property
    def share(self) -> NDArray[np.float32]:
        """Share [I, J, K] of the density whose masks say brain."""
        return brain_share(self.masked_density, self.density)


def _with_room(grid: VolumeGrid, box_mm: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> VolumeGrid:
    """The grid, larger on the sides where a box reaches `CUT_OFF_MM` beyond the pixels that it was made for."""
    if box_mm is None:
        return grid
    low, high = grid.world([0, 0, 0]), grid.world(np.array(grid.shape) - 1)
    inner_low, inner_high = low + MARGIN_MM, high - MARGIN_MM
    new_low = np.where(box_mm[0] < inner_low - CUT_OFF_MM, box_mm[0] - MARGIN_MM, low)
    new_high = np.where(box_mm[1] > inner_high + CUT_OFF_MM, box_mm[1] + MARGIN_MM, high)
    if (new_low == low).all() and (new_high == high).all():
        return grid
    return VolumeGrid.isotropic(new_low, new_high, float(grid.spacing_mm[0]))


@dataclass(frozen=True, kw_only=True)
class PriorVolume:
    """V_prior with its masks: start and target of the fit.

    Attributes:
        volumes: the slices as they are fitted, and the volumes that they give.
        values: V_prior [I, J, K] on their grid (G3R Eq. 7); V_sharp, smoothly continued, where no network is used.
        brain: probability [I, J, K] of each voxel being brain by its shape; None where no network is used.
        mask: [I, J, K] the brain: as seen, and by its shape where nothing was seen.
        support: [I, J, K] where Gaussians are fitted: the mask and its margin.
        has_template: whether an atlas template was fitted, which V_prior shows where no slice looked.
        gain: [K] intensity factors of the slices.
        scale: intensity that slices were divided by since registration.
        accepted: whether slices of a single stack moved to the prior; None where that was not tried.
    """

    volumes: InitialVolumes
    values: NDArray[np.float32]
    brain: NDArray[np.float32] | None
    mask: NDArray[np.bool_]
    support: NDArray[np.bool_]
    has_template: bool
    gain: NDArray[np.float64]
    scale: float
    accepted: bool | None = None
