"""Images that were set to zero around the brain, as brain extraction leaves them, or around their field of view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes

from g3r.acquisition.planes import Slices
from g3r.geometry.grid import bounding_box

MOSTLY = 0.9
"""Share of the pixels beside its mask from which on a stack is cut: simulated stacks of a head in black have no zeros
there, or a few where they have no noise, since these pixels are partly brain; masked ones have nothing else. Also the
share of a rectangle that must not be zero for it to be a field of view."""

NEARLY_ZERO = 1e-3
"""Share of the median of tissue (in the mask) below which a pixel was set to zero, and perhaps resampled since."""

FEW = 0.01
"""Share of zeros in a mask that noise or rounding may leave."""

TOP_PERCENTILE, SMALL = 99.9, 0.01
"""Values below this share of a high percentile are no tissue. An extracted brain may be half a percent of its image, so
that the 99th percentile would be of its background."""

DARK = 0.05
"""Share of the median of tissue below which noise has many values, also in few grey levels, and a constant one."""


def without_residue(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image with zeros where it is nearly zero, as interpolation or stored offsets leave what was set to zero.

    Nearly zero is below `NEARLY_ZERO` of the median of tissue. So is a constant up to `SMALL` of it, which the offset
    of a header (scl_inter) leaves, if hardly another value is dark: noise has many.

    Args:
        image: of any shape, arbitrary units; what is not finite stays.
    """
    size = np.abs(image[np.isfinite(image)])
    # "lower", since the mean of two very large numbers would overflow
    top = np.percentile(size, TOP_PERCENTILE, method="lower") if size.size else np.float32(0)
    if top <= 0:
        return image
    typical = float(np.median(size[size > SMALL * top]))
    limit = NEARLY_ZERO * typical
    empty = np.abs(image) <= limit
    dark = image[np.abs(image) <= DARK * typical]
    level = np.median(dark) if dark.size > FEW * image.size else np.float32(0)
    if 0 < abs(level) <= SMALL * typical and np.mean(np.abs(dark - level) <= limit) > MOSTLY:
        empty |= np.abs(image - level) <= limit
    return np.where(empty, np.float32(0), image)


def cut_at_mask(slices: Slices) -> NDArray[np.bool_]:
    """Whether the stack of each slice was set to zero beyond its mask [K].

    What is zero there was not measured: pixels whose middle lies just outside the mask hold brain, too.
    """
    cut = np.zeros(len(slices), bool)
    plane = slices.planes.plane_id()
    for stack in np.unique(slices.stack_id):
        own = slices.stack_id == stack
        rows = np.flatnonzero(own)
        inside = np.abs(slices.value[own[plane] & slices.mask])
        limit = NEARLY_ZERO * float(np.median(inside)) if inside.size else 0.0
        rims = [_beside_mask(slices, k) for k in rows.tolist()]
        beside = np.abs(np.concatenate(rims))
        cut[rows] = np.count_nonzero(beside <= limit) > MOSTLY * len(beside)
    return cut


def _beside_mask(slices: Slices, k: int) -> NDArray[np.float32]:
    start, shape = slices.planes.offset[k], slices.planes.shape[k]
    pixels = slice(start, start + int(shape.prod()))
    mask, value = (one[pixels].reshape(shape) for one in (slices.mask, slices.value))
    return np.asarray(value[binary_dilation(mask) & ~mask])


def mask_of_content(image: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask [I, J, K] without the zeros around an image that was cut out more narrowly than its mask.

    Zeros that content surrounds stay, and so do slices that are zero throughout.

    Args:
        image: [I, J, K] slices along the third axis, `without_residue`.
        mask: of the brain.
    """
    zero = (image == 0) & mask
    if zero.sum() <= FEW * mask.sum():
        return mask
    found = mask.copy()
    for k in np.flatnonzero((mask & ~zero).any((0, 1))):
        found[:, :, k] &= binary_fill_holes(image[:, :, k] != 0)
    return found


def field_of_view(image: NDArray[np.float32]) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last index, along both axes of a slice, of the pixels that were acquired.

    All of them, unless zeros pad a rectangle of pixels that mostly are not zero.

    Args:
        image: [I, J, K] slices along the third axis, `without_residue`.
    """
    whole = tuple((0, n - 1) for n in image.shape[:2])
    content = image != 0
    seen = content.any(2)
    if not seen.any():
        return whole[0], whole[1]
    box = bounding_box(seen)
    in_box = content[box][:, :, content.any((0, 1))]
    if in_box.mean() < MOSTLY:
        return whole[0], whole[1]
    rows, columns = ((axis.start, axis.stop - 1) for axis in box)
    return rows, columns
