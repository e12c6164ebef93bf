"""What a fit starts from: slices of order one, and the volumes that posed slices give by themselves."""

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
"""Of the prior's grid around the masked pixels."""


@dataclass(frozen=True)
class FitStart:
    """Slices, V_coarse and V_sharp in normalised intensities (given ones over `scale`), M_rho, mask."""

    slices: Slices
    coarse: NDArray[np.float32]
    density: NDArray[np.float32]
    sharp: NDArray[np.float32]
    mask: NDArray[np.bool_]
    grid: VolumeGrid
    scale: float

    @classmethod
    def of(cls, slices: Slices, gain: NDArray[np.float64], weight: NDArray[np.float64], voxel_mm: float) -> FitStart:
        """The start for slices in their poses.

        Args:
            slices: K slices.
            gain: [K] intensity factors.
            weight: [K] trust.
            voxel_mm: of the grid.
        """
        grid = grid_around(slices, voxel_mm, margin_mm=MARGIN_MM)
        slice_weight = weight[slices.pixel_plane]
        coarse, density = coarse_and_density(slices, grid, gain, slice_weight)
        sharp = sharpened_volume(slices, grid, coarse, gain, slice_weight)
        scale = normalisation_scale(coarse, density)
        slices = slices.scaled(1 / scale)
        mask = foreground_mask(slices, grid, weight)
        return cls(slices, coarse / np.float32(scale), density, sharp / np.float32(scale), mask, grid, scale)


def with_pixels_of(slices: Slices, motion: Registration) -> Registration:
    """A motion estimate with the pixels of the slices to be fitted.

    Raises:
        InputError: the two are not about the same slices.
    """
    found = motion.slices
    if not (np.array_equal(found.stack_id, slices.stack_id) and np.array_equal(found.slice_index, slices.slice_index)):
        raise InputError(
            f"motion of {len(found)} slices; expected {len(slices)} slices of these stacks in their order; "
            "register the same stacks with the same masks"
        )
    return replace(motion, slices=slices.with_pose(found.planes.pose))


def gaussian_spacing_mm(slices: Slices, spacing_pixels: float) -> float:
    """Cell edge per Gaussian: a number of (typical) pixels, as cubes of equal volume."""
    covered_mm3 = slices.planes.spacing_mm.prod(1) * slices.thickness_mm
    return spacing_pixels * float(np.median(covered_mm3)) ** (1 / 3)
