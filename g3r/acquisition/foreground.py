"""Which voxels the slices' masks call brain, once the slices are in place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, gaussian_filter, label

from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

INSIDE_SHARE = 0.36
"""Share of the typical density from which a voxel counts: below one half, where the edge of a mask lies,
because a voxel too few loses brain. A mask of just the volume of the stacks' masks costs 1 to 4 dB in their
rim; one much more generous (0.25) shows values there that no slice determines (docs/method.md, "Mask")."""


def foreground_mask(density: NDArray[np.float32], slices: Slices, grid: VolumeGrid) -> NDArray[np.bool_]:
    """Brain mask [I, J, K] from the density of masked pixels.

    The density is smoothed over half the distance of slices (so that gaps close), compared with its typical
    value inside, and reduced to the largest piece without holes.

    Raises:
        InputError: no voxel is covered.
    """
    spacing = _slice_distance_mm(slices)
    smooth = gaussian_filter(density, 0.5 * spacing / grid.spacing_mm.mean())
    covered = smooth[smooth > 0.1 * smooth.max(initial=0.0)]
    if covered.size == 0:
        raise InputError("no voxel is covered by a slice; check masks and headers")
    inside = smooth > INSIDE_SHARE * float(np.median(covered))
    pieces, n_pieces = label(inside)
    if n_pieces > 1:
        inside = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    return binary_fill_holes(inside)


def _slice_distance_mm(slices: Slices) -> float:
    """The largest typical distance of neighbouring slices among the stacks, by their headers."""
    distances = []
    for stack in np.unique(slices.stack_id):
        of_stack = slices.stack_id == stack
        center = slices.header_pose.translation_mm[of_stack]
        normal = slices.header_pose.rotation[of_stack][:, :, 2]
        step = np.abs(((center[1:] - center[:-1]) * normal[1:]).sum(1))
        index_step = np.maximum(np.diff(slices.slice_index[of_stack]), 1)
        distances.append(
            np.median(step / index_step) if len(step) else float(slices.thickness_mm[of_stack][0])
        )
    return float(max(distances))
