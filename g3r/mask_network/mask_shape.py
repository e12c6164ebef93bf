"""Shape of a mask: from the brain pixels of a network to the outline that a person would draw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt, label

from g3r.geometry.grid import bounding_box

JOIN_MM = 6.0
"""Parts of a mask at most this far apart belong together, because a head moves between slices."""
LEAST_END_PROBABILITY = 0.6
"""Least mean over a section at either end: 0.77 and more in real stacks where it shows brain, else 0.46 to 0.52."""

LARGEST_RADIUS = 1.2
"""Largest distance of brain from its middle, in radii of the ellipsoid with the moments of the mask."""
MIN_VOXELS = 50
"""Least voxels from which an ellipsoid is estimated."""
CLEFT_MM = 10.0
"""Half the width of clefts in a section that are filled: people bridge the gap between the lobes, and so do the masks
of the training data."""
RIM_MM = 3.5
"""Distance outside the brain at which the outline is drawn: people draw it beyond the skull."""


def cleaned(mask: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """The largest part of a mask with its holes filled; parts that nearly touch, also in adjacent slices, are joined.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    if not mask.any():
        return mask
    reach = np.maximum(np.round(JOIN_MM / 2 / spacing_mm[:2]).astype(int), 1)
    part = bounding_box(mask)
    result = np.zeros_like(mask)
    result[part] = _joined(mask[part], reach)
    return result


def _joined(mask: NDArray[np.bool_], reach: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The largest part of a non-empty mask, see `cleaned`.

    Args:
        mask: [I, J, K].
        reach: pixels by which parts are widened along both axes of the plane.
    """
    element = np.ones((2 * reach[0] + 1, 2 * reach[1] + 1, 1), dtype=bool)
    near = np.stack([np.any(mask[:, :, max(k - 1, 0) : k + 1], 2) for k in range(mask.shape[2])], 2)
    parts, n = label(binary_dilation(near, element))
    size = np.bincount(parts[mask], minlength=n + 1)
    size[0] = 0
    kept = mask & (parts == int(size.argmax()))
    return np.stack([binary_fill_holes(kept[:, :, k]) for k in range(kept.shape[2])], axis=2)


def without_outgrowths(
    mask: NDArray[np.bool_], probability: NDArray[np.floating], spacing_mm: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """A mask without parts that stick out of an ellipsoid: a brain is nearly one, and face and neck lie beyond it.

    Args:
        mask: [I, J, K].
        probability: [I, J, K] of brain, the weights of the ellipsoid's moments.
        spacing_mm: [3].
    """
    index = np.argwhere(mask)
    position_mm, weight = index * spacing_mm, probability[mask]
    kept = np.ones(len(index), dtype=bool)
    for _ in range(4):  # each round fits the voxels that the one before kept
        if kept.sum() < MIN_VOXELS:
            return mask
        offset = position_mm - np.average(position_mm[kept], axis=0, weights=weight[kept])
        covariance = np.cov(offset[kept].T, aweights=weight[kept], ddof=0)
        if np.linalg.matrix_rank(covariance) < 3:  # a single slice
            return mask
        # a solid ellipsoid's variance along an axis is a fifth of its radius squared
        radius = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset) / 5)
        kept = radius < LARGEST_RADIUS
    result = np.zeros_like(mask)
    result[tuple(index[kept].T)] = True
    return result


def without_doubtful_ends(mask: NDArray[np.bool_], probability: NDArray[np.floating]) -> NDArray[np.bool_]:
    """A mask without improbable sections at both ends, such as neck or face beyond the brain.

    Args:
        mask: [I, J, K].
        probability: [I, J, K] of brain.
    """
    used = np.flatnonzero(mask.any((0, 1)))
    likely = [k for k in used if probability[:, :, k][mask[:, :, k]].mean() >= LEAST_END_PROBABILITY]
    result = np.zeros_like(mask)
    if likely:
        result[:, :, likely[0] : likely[-1] + 1] = mask[:, :, likely[0] : likely[-1] + 1]
    return result


def without_clefts(mask: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """A mask whose sections are closed by a disc of `CLEFT_MM`.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    result = mask.copy()
    room = np.ceil(CLEFT_MM / spacing_mm[:2]).astype(int) + 1
    for k in np.flatnonzero(mask.any((0, 1))):
        box = bounding_box(mask[:, :, k])
        # room for the disc beyond the field of view, too, whose edge is no border of the brain
        section = np.pad(mask[:, :, k][box], [(n, n) for n in room])
        wide = distance_transform_edt(~section, sampling=spacing_mm[:2]) <= CLEFT_MM
        closed = distance_transform_edt(wide, sampling=spacing_mm[:2]) > CLEFT_MM
        result[:, :, k][box] |= closed[room[0] : -room[0], room[1] : -room[1]]
    return result


def as_people_draw(mask: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """A mask with a rim of `RIM_MM` around each section.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    result = np.zeros_like(mask)
    room = np.ceil(RIM_MM / spacing_mm[:2]).astype(int)
    for k in np.flatnonzero(mask.any((0, 1))):
        section, drawn = mask[:, :, k], result[:, :, k]
        box = bounding_box(section, room)
        drawn[box] = distance_transform_edt(~section[box], sampling=spacing_mm[:2]) <= RIM_MM
    return result
