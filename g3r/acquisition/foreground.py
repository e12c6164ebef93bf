"""Which voxels the slices' masks call brain, once the slices are in place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, gaussian_filter, label

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.slicing import slice_spacing_mm
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

INSIDE_SHARE = 1 / 3
"""Share of the slices over a voxel that must call it brain: one of three stacks. At one half, where the edge
of a mask lies, the volume is right to 1 %, but the outermost voxels are lost here and there, and with them 1
to 4 dB; this is generous by about a quarter of the distance of slices (docs/method.md, "Mask")."""

MIN_DENSITY = 0.1
"""Coverage (1 is one gapless stack) below which nobody is asked: what no slice has seen is not brain."""

RIM_MM = 6.0
"""How far beyond its mask's bounding box a slice says that there is no brain."""


def foreground_mask(slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating] | None = None) -> NDArray[np.bool_]:
    """Brain mask [I, J, K]: where most of the slices that cover a voxel have it in their masks.

    Masked and unmasked pixels are spread through their PSF; what lies beyond the first and the last slice of
    a stack counts as unmasked. Both are smoothed over half the distance of slices (so that gaps close). The
    largest piece is taken, without holes.

    Args:
        slices: K slices in place.
        grid: of the mask.
        weight: [K] trust in each slice; one that lies wrongly should have no vote.

    Raises:
        InputError: no voxel is covered.
    """
    weight = np.ones(len(slices)) if weight is None else np.asarray(weight, dtype=np.float64)
    planes, mask, source = _with_surroundings(slices)
    operator = VoxelOperator(planes, grid, None, (1, 1, 5))
    volume_mm3 = planes.spacing_mm.prod(1) * (slices.thickness_mm * weight)[source]
    covered = (volume_mm3 / grid.voxel_volume_mm3)[operator.plane].astype(np.float32)
    inside, total = operator.adjoint(covered * mask), operator.adjoint(covered)
    distance_mm = max(slice_spacing_mm(slices.take(slices.stack_id == stack)) for stack in np.unique(slices.stack_id))
    sigma = 0.5 * distance_mm / grid.spacing_mm.mean()
    inside, total = gaussian_filter(inside, sigma), gaussian_filter(total, sigma)
    brain = (inside > INSIDE_SHARE * total) & (inside > MIN_DENSITY)
    pieces, n_pieces = label(brain)
    if n_pieces == 0:
        raise InputError("no voxel is covered by a slice; check masks and headers")
    if n_pieces > 1:
        brain = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    return binary_fill_holes(brain)


def _with_surroundings(slices: Slices) -> tuple[Planes, NDArray[np.bool_], NDArray[np.int64]]:
    """The slices' planes with a rim, and planes without brain beyond the ends of each stack.

    Returns:
        L planes, their masks [P], and which slice each was made from [L].
    """
    planes = slices.planes
    rim = np.ceil(RIM_MM / planes.spacing_mm).astype(np.int64)
    ends, steps = _ends(slices)
    source = np.concatenate([np.arange(len(slices)), ends])
    center = planes.center_mm[source]
    center[len(slices) :] += steps
    wide = Planes(
        planes.rotation[source],
        center,
        planes.spacing_mm[source],
        (planes.shape + 2 * rim)[source],
        planes.psf_var_mm2[source],
    )
    mask = np.zeros(wide.n_pixels, bool)
    for k in range(len(slices)):
        own = slices.mask[planes.offset[k] : planes.offset[k + 1]].reshape(planes.shape[k])
        padded = np.pad(own, [(int(n), int(n)) for n in rim[k]])
        mask[wide.offset[k] : wide.offset[k + 1]] = padded.ravel()
    return wide, mask, source


def _ends(slices: Slices) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The first and last slice of each stack, and the step (mm) from each to where the next one would lie."""
    ends, steps = [], []
    for stack in np.unique(slices.stack_id):
        rows = np.flatnonzero(slices.stack_id == stack)
        header = slices.header_pose
        along = header.translation_mm[rows[-1]] - header.translation_mm[rows[0]]
        normal = header.rotation[rows[0]][:, 2]
        n_steps = int(slices.slice_index[rows[-1]] - slices.slice_index[rows[0]])
        step_mm = float(along @ normal) / n_steps if n_steps else float(slices.thickness_mm[rows[0]])
        for row, sign in ((rows[0], -1.0), (rows[-1], 1.0)):
            ends.append(row)
            steps.append(sign * step_mm * slices.planes.rotation[row][:, 2])
    return np.array(ends, dtype=np.int64), np.array(steps).reshape(-1, 3)
