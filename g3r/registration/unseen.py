"""The atlas template for what no other stack saw, in place of the zeros of a volume made of the other stacks.

A volume of the other stacks is zero where they lack slices. A zero there is not evidence: a slice that belongs in the
hole would fit better elsewhere, and holes would be registered to holes. The template, in the frame that the slices are
in, predicts roughly what lies there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from g3r.acquisition.atlas_template import PlacedHead
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.grid import on_grid

FULL_COVERAGE = 0.3
"""Coverage from which on a voxel was seen and the template has no weight; 1 is that of one stack. It is far below 1, as
coverage by some of all pixels is uneven: with a standard deviation of 0.20 where two stacks are thinned to 100,000."""

SPAN_SLICES = 4
"""Slices on either side of a missing span whose mean places give its length; even, for interleaved stacks."""


def grid_with_head(grid: VolumeGrid, head: PlacedHead) -> VolumeGrid:
    """A grid with the voxels of another one that covers it and a whole head."""
    low, high = head.box_mm()
    corners = grid.world(grid.corner_index)
    spacing_mm = float(grid.spacing_mm[0])
    return VolumeGrid.isotropic(np.minimum(low, corners.min(0)), np.maximum(high, corners.max(0)), spacing_mm)


def filled_with_head(
    volume: NDArray[np.float32], grid: VolumeGrid, coverage: NDArray[np.float32], head: PlacedHead
) -> NDArray[np.float32]:
    """A volume with the template where no pixel was seen.

    Args:
        volume: [I, J, K] of some slices.
        grid: its grid.
        coverage: [I, J, K] of those slices (outside the head, too), see `coverage_share`.
        head: of the template, in the frame of the slices.
    """
    template = on_grid(head.volume, head.grid, grid, 0.0)
    share = coverage_share(coverage)
    known = (share >= 1) & (template > 0)
    scale = 1.0
    if known.any():
        scale = float(np.clip((volume[known] @ template[known]) / (template[known] @ template[known]), 0.5, 2.0))
    return (share * volume + (1 - share) * np.float32(scale) * template).astype(np.float32)


def coverage_share(coverage: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far each voxel was seen, from 0 (not) to 1.

    The limit is a part of what one stack gives, however many others there are and wherever they looked.

    Args:
        coverage: [I, J, K] volume of pixels, spread by the PSF, over that of the voxel, with slices as thick as their
            spacing: about 1 where one stack looked, whatever its pixels.
    """
    return np.minimum(coverage / np.float32(FULL_COVERAGE), 1.0).astype(np.float32)


def sampled(volume: NDArray[np.float32], grid: VolumeGrid, point_mm: NDArray[np.float64]) -> NDArray[np.float32]:
    """A volume at points [P, 3] of the world (trilinear), 0 outside its grid."""
    matrix = np.linalg.inv(grid.affine)
    place = matrix[:3, :3] @ point_mm.T + matrix[:3, 3:]
    return map_coordinates(volume, place, order=1, output=np.float32)


def with_header_spans(header_pose: RigidPose, motion: RigidPose, slice_index: NDArray[np.int64]) -> RigidPose:
    """Motions of a single stack with missing spans as long as the header says.

    Slices behind a span may turn and shift in plane against those before it. A jump along the normal would only
    close or widen the hole: it would fit the template, which is another head, and no other stack checks it.

    Args:
        header_pose: [K] of the slices of one stack, in the order of their numbers.
        motion: [K] world from header.
        slice_index: [K] numbers of the slices in their stack.
    """
    translation = motion.translation_mm.copy()
    for first in np.flatnonzero(np.diff(slice_index) > 1) + 1:
        near = slice(max(0, first - SPAN_SLICES), first), slice(first, first + SPAN_SLICES)
        place = motion.rotation @ header_pose.translation_mm[..., None]
        place = place[..., 0] + translation
        normal = (motion.rotation @ header_pose.rotation)[near[0].start : near[1].stop, :, 2].mean(0)
        normal /= np.linalg.norm(normal)
        middle = header_pose.translation_mm
        given_mm = float(header_pose.rotation[first, :, 2] @ (middle[near[1]].mean(0) - middle[near[0]].mean(0)))
        found_mm = float(normal @ (place[near[1]].mean(0) - place[near[0]].mean(0)))
        translation[first:] += (given_mm - found_mm) * normal
    return RigidPose(motion.rotation, translation)
