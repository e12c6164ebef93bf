"""The brain mask of the volume, from the masks of registered slices."""

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
"""Share of the slices over a voxel whose masks must contain it: one of three stacks. At one half, the edge of a
mask, the volume of the brain is right to 1 %, but some outermost voxels are lost, and with them 1 to 4 dB; one
third is generous by about a quarter of the slice spacing (docs/method.md, "Mask")."""

MIN_DENSITY = 0.1
"""Coverage (1 is one gapless stack) below which a voxel is not brain, because no slice has seen it."""

RIM_MM = 6.0
"""How far around the bounding box of its mask a slice counts as background."""


def foreground_mask(slices: Slices, grid: VolumeGrid, weight: NDArray[np.floating] | None = None) -> NDArray[np.bool_]:
    """Brain mask [I, J, K]: voxels that enough of the slices covering them have in their masks.

    Masked and unmasked pixels are spread through their PSF; the space beyond the first and the last slice of a
    stack counts as unmasked. Both are smoothed over half the slice spacing, which closes gaps. The largest
    connected component is taken, and its holes are filled.

    Args:
        slices: K slices in place.
        grid: of the mask.
        weight: [K] slice weights, so that misplaced slices have no vote.

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
    """The planes with a margin of background, and planes of background beyond the ends of each stack.

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
        rotation=planes.rotation[source],
        center_mm=center,
        spacing_mm=planes.spacing_mm[source],
        shape=(planes.shape + 2 * rim)[source],
        psf_var_mm2=planes.psf_var_mm2[source],
    )
    mask = np.zeros(wide.n_pixels, bool)
    for k in range(len(slices)):
        own = slices.mask[planes.offset[k] : planes.offset[k + 1]].reshape(planes.shape[k])
        padded = np.pad(own, [(int(n), int(n)) for n in rim[k]])
        mask[wide.offset[k] : wide.offset[k + 1]] = padded.ravel()
    return wide, mask, source


def _ends(slices: Slices) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The first and last slice of each stack, and the step (mm) from each to the next one outside the stack."""
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
