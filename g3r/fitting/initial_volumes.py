"""Start of a fit: normalised slices, and the volumes that posed slices determine without a prior."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density, normalisation_scale
from g3r.acquisition.foreground import foreground_mask
from g3r.acquisition.least_squares import sharpened_volume
from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.geometry import VolumeGrid
from g3r.registration import Registration

MARGIN_MM = 5.0
"""Margin of the prior's grid around the masked pixels."""


@dataclass(frozen=True, kw_only=True)
class InitialVolumes:
    """Posed slices and the volumes that they give by themselves, in normalised intensities.

    Attributes:
        slices: given intensities over `scale`.
        coarse: V_coarse [I, J, K] (G3R Eq. 6).
        density: M_rho [I, J, K] (G3R Eq. 6).
        sharp: V_sharp [I, J, K], the least-squares volume.
        mask: foreground [I, J, K].
        grid: of all four.
        scale: what intensities were divided by.
    """

    slices: Slices
    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    sharp: NDArray[np.float32]
    mask: NDArray[np.bool_]
    grid: VolumeGrid
    scale: float

    @classmethod
    def of(
        cls, slices: Slices, gain: NDArray[np.float64], weight: NDArray[np.float64], voxel_mm: float
    ) -> InitialVolumes:
        """The volumes of slices in their poses.

        Args:
            slices: K slices.
            gain: [K] intensity factors.
            weight: [K] slice weights.
            voxel_mm: voxel size of the grid.
        """
        grid = grid_around(slices, voxel_mm, margin_mm=MARGIN_MM)
        slice_weight = weight[slices.pixel_plane]
        coarse, density = coarse_and_density(slices, grid, gain, slice_weight)
        sharp = sharpened_volume(slices, grid, coarse, gain, slice_weight)
        scale = normalisation_scale(coarse, density)
        slices = slices.scaled(1 / scale)
        mask = foreground_mask(slices, grid, weight)
        coarse, sharp = coarse / np.float32(scale), sharp / np.float32(scale)
        return cls(slices=slices, coarse=coarse, density=density, sharp=sharp, mask=mask, grid=grid, scale=scale)


@dataclass(frozen=True, kw_only=True)
class PriorVolume:
    """Start and target of the fit.

    Attributes:
        volumes: the slices as they are fitted, and the volumes that they give.
        values: V_prior [I, J, K] on their grid (G3R Eq. 7); V_sharp where no network is used.
        gain: [K] intensity factors of the slices.
        scale: what intensities were divided by since registration.
        accepted: whether slices of a single stack moved to the prior; None where that was not tried.
    """

    volumes: InitialVolumes
    values: NDArray[np.float32]
    gain: NDArray[np.float64]
    scale: float
    accepted: bool | None = None


def with_pixels_of(slices: Slices, registration: Registration) -> Registration:
    """A registration with the pixels of the slices to be fitted.

    Raises:
        InputError: the two are not about the same slices.
    """
    found = registration.slices
    if not (np.array_equal(found.stack_id, slices.stack_id) and np.array_equal(found.slice_index, slices.slice_index)):
        raise InputError(
            f"registration of {len(found)} slices; expected {len(slices)} slices of these stacks in their order; "
            "register the same stacks with the same masks"
        )
    return replace(registration, slices=slices.with_pose(found.planes.pose))


def gaussian_spacing_mm(slices: Slices, spacing_pixels: float) -> float:
    """Cell edge per Gaussian: a number of (typical) pixels, as cubes of equal volume."""
    covered_mm3 = slices.planes.spacing_mm.prod(1) * slices.thickness_mm
    return spacing_pixels * float(np.median(covered_mm3)) ** (1 / 3)
