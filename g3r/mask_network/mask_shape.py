"""From the pixels that a network calls brain to the outline that a person would draw."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt, label
from scipy.spatial import ConvexHull, QhullError

from g3r.geometry.grid import bounding_box

JOIN_MM = 6.0
"""Parts of a mask no further from each other belong together: a head moves between slices."""
TONGUE_MM = 3.0
"""What a disc of this radius does not fit into is no part of a brain's section: the network leaks along the face."""
MIN_SOLID = 0.8
"""Sections of a brain fill more of their convex hull; where they no longer do, skull base and face begin."""
RIM_MM = 2.5
"""The outline is drawn so far outside the brain, as people draw it: the fit wants a little of what is around."""


def cleaned(mask: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """The largest part of a mask with its holes filled; parts that nearly touch, also in the next slice, are one.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    index = np.argwhere(mask)
    if not len(index):
        return mask
    reach = np.maximum(np.round(JOIN_MM / 2 / spacing_mm[:2]).astype(int), 1)
    low, high = index.min(0), index.max(0) + 1
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    result = np.zeros_like(mask)
    result[part] = _joined(mask[part], reach)
    return result


def _joined(mask: NDArray[np.bool_], reach: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The largest part of a mask that is not empty, see `cleaned`.

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


def without_tongues(mask: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """A mask whose sections are compact; from the largest one outwards it ends before the first that is not.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    if not mask.any():
        return mask
    opened = _by_slice(mask, spacing_mm, _opened)
    area = opened.sum((0, 1))
    kept = np.zeros_like(mask)
    largest = int(area.argmax())
    for numbers in (range(largest, len(area)), range(largest - 1, -1, -1)):
        for k in numbers:
            section = opened[:, :, k]
            if k != largest and not (section.any() and _solidity(section) >= MIN_SOLID):
                break
            kept[:, :, k] = section
    return kept


def as_people_draw(mask: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """A mask with a rim of `RIM_MM` around each section.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
    """
    return _by_slice(mask, spacing_mm, lambda section, mm: distance_transform_edt(~section, sampling=mm) <= RIM_MM)


def _by_slice(
    mask: NDArray[np.bool_],
    spacing_mm: NDArray[np.floating],
    change: Callable[[NDArray[np.bool_], NDArray[np.floating]], NDArray[np.bool_]],
) -> NDArray[np.bool_]:
    """What becomes of every section that is not empty, in a box with room around it.

    Args:
        mask: [I, J, K].
        spacing_mm: [3].
        change: makes a section [I', J'] of another, given its spacing [2].
    """
    result = np.zeros_like(mask)
    room = np.ceil((RIM_MM + TONGUE_MM) / spacing_mm[:2]).astype(int) + 1
    for k in np.flatnonzero(mask.any((0, 1))):
        section, changed = mask[:, :, k], result[:, :, k]
        box = bounding_box(section, room)
        changed[box] = change(section[box], spacing_mm[:2])
    return result


def _opened(section: NDArray[np.bool_], spacing_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """The largest part of what a disc of `TONGUE_MM` fits into; empty where it fits nowhere."""
    padded = np.pad(section, 1)
    core = distance_transform_edt(padded, sampling=spacing_mm) > TONGUE_MM
    if not core.any():
        return np.zeros_like(section)
    opened = (distance_transform_edt(~core, sampling=spacing_mm) <= TONGUE_MM)[1:-1, 1:-1]
    parts, n = label(opened)
    return opened if n < 2 else parts == 1 + int(np.bincount(parts.ravel())[1:].argmax())


def _solidity(section: NDArray[np.bool_]) -> float:
    """Share of its convex hull that a section fills."""
    index = np.argwhere(section)
    corners = np.concatenate([index + offset for offset in ([0, 0], [0, 1], [1, 0], [1, 1])])
    try:
        return len(index) / float(ConvexHull(corners).volume)  # of a plane figure this is the area
    except QhullError:
        return 1.0
