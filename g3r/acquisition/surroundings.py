"""What lies just outside the brain, and its part in the pixels of the rim.

A pixel at the edge of the mask averages over its slice profile: partly brain, partly what lies beside it, which is
black where the stacks were cut out, fluid and skull where they were not. The volume ends with the brain. If such a
pixel is fitted as if it had seen brain alone, the rim takes the blame: too dark beside black, too bright beside fluid.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid

LEAST_SHARE = 0.3
"""Share of brain in a pixel that is at least assumed: below, noise is blown up for little."""

OUTSIDE_SHARE = 0.5
"""Unmasked pixels with less brain than this tell what is outside."""

KNOWN_SHARE = 0.05
"""Voxels outside with less than this share of the usual sampling are unknown, and correct nothing."""

REACH_SIGMA = 2.5
"""Pixels this far inside the brain, in sigmas of their profile, see brain alone."""

NODES = (3, 3, 5)


def without_surroundings(
    slices: Slices, brain: NDArray[np.bool_], grid: VolumeGrid, gain: NDArray[np.floating], weight: NDArray[np.floating]
) -> tuple[Slices, NDArray[np.float32]]:
    """The slices as if nothing but brain lay beneath their masked pixels.

    y = s V + (1 - s) V_outside for a pixel with the share s of its profile in the brain, where V and V_outside are
    means over the two parts; V_outside is what unmasked pixels saw there. The pixel becomes (y - (1 - s) V_outside) / s
    and counts with the weight s, so that its noise counts as before.

    Args:
        slices: K slices in place, with the unmasked pixels of their boxes.
        brain: [I, J, K] where the volume is fitted.
        grid: of the brain.
        gain: [K] intensity factors.
        weight: [K] slice weights.

    Returns:
        The slices, and the share s [P] of every pixel (1 where nothing is known of the outside).
    """
    inside = brain.astype(np.float32)
    outside, known = _outside(slices, inside, grid, gain, weight)
    inside[~known & ~brain] = 1
    planes = slices.planes
    index = slices.pixel_index
    depth_mm = distance_transform_edt(brain, sampling=grid.spacing_mm)
    place = grid.index(planes.pixel_world_mm()[index]).T
    reach_mm = REACH_SIGMA * np.sqrt(planes.psf_var_mm2.max(1))[slices.pixel_plane]
    near = map_coordinates(depth_mm.astype(np.float32), place, order=1, mode="nearest") < reach_mm
    index = index[near]
    share = np.ones(len(slices.value), np.float32)
    value = slices.value.copy()
    if len(index):
        operator = VoxelOperator(planes, grid, index, NODES)
        share[index] = np.clip(operator.forward(inside), LEAST_SHARE, 1)
        beside = operator.forward(outside * (1 - inside)) * gain[operator.plane]
        value[index] = (value[index] - beside) / share[index]
    return replace(slices, value=value), share


def _outside(
    slices: Slices,
    inside: NDArray[np.float32],
    grid: VolumeGrid,
    gain: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """What unmasked pixels saw beside the brain [I, J, K], and where they saw anything."""
    none = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, bool)
    index = np.flatnonzero(~slices.mask)
    if not len(index):
        return none
    index = index[VoxelOperator(slices.planes, grid, index, NODES).forward(inside) < OUTSIDE_SHARE]
    if not len(index):
        return none
    operator = VoxelOperator(slices.planes, grid, index, NODES)
    counted = weight[operator.plane].astype(np.float32)
    value = (slices.value[index] / gain[operator.plane]).astype(np.float32)
    sampling, total = operator.adjoint(counted), operator.adjoint(counted * value)
    known = sampling > KNOWN_SHARE * np.median(sampling[sampling > 0])
    return np.divide(total, sampling, out=none[0], where=known), known
