"""Correction of rim pixels for what lies beside the brain.

A pixel at the edge of the mask averages over its slice profile, partly over brain and partly over what lies beside it:
black where the stacks are brain-extracted, else fluid and skull. The volume ends with the brain. If such a pixel were
fitted as if it had seen brain alone, the rim would become too dark next to black and too bright next to fluid.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from g3r.acquisition.cut_images import cut_at_mask
from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid

LEAST_SHARE = 0.3
"""Lower bound of the share of brain in a pixel: a smaller share would amplify noise for little gain."""

OUTSIDE_SHARE = 0.5
"""Unmasked pixels with a smaller share of brain than this determine the intensities outside."""

KNOWN_SHARE = 0.05
"""Voxels outside that are sampled less than this share of the median are unknown, and correct nothing."""

REACH_SIGMA = 2.5
"""Pixels this far inside the brain, in sigmas of their PSF, see brain alone."""

NODES = (3, 3, 5)


def without_surroundings(
    slices: Slices, brain: NDArray[np.bool_], grid: VolumeGrid, gain: NDArray[np.floating], weight: NDArray[np.floating]
) -> tuple[Slices, NDArray[np.float32]]:
    """The slices corrected as if nothing but brain lay beneath their masked pixels.

    y = s V + (1 - s) V_outside for a pixel with the share s of its profile in the brain, where V and V_outside are
    means over the two parts; V_outside comes from unmasked pixels. The pixel becomes (y - (1 - s) V_outside) / s and
    has the weight s, so that its noise counts as before.

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
    """Mean of unmasked pixels beside the brain [I, J, K], and where it is known."""
    none = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, bool)
    measured = ~cut_at_mask(slices)[slices.planes.plane_id()]
    index = np.flatnonzero(~slices.mask & measured)
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
