"""Brightness of a stack: the detail inside a part of it, and the stack with its brightness evened out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from g3r.geometry.grid import bounding_box

Image = NDArray[np.float32]
Array = NDArray[np.floating]

NOISE_MM, COARSE_MM = 2.0, 6.0
"""Standard deviations of in-plane smoothing: detail lies between noise, and shading and large structures."""
SKIN_MM = 5.0
"""Outermost part of a section that is ignored, because its edge is not detail."""
MIN_INNER_MM2 = 200.0
"""Sections with less area inside the skin are not judged."""
MIN_SECTIONS = 3
"""With fewer sections the detail is unknown."""
EVEN_MM = 25.0
"""Standard deviation of the in-plane smoothing that evens out brightness: less than a head, more than its parts."""
DARKEST_SHARE = 0.1
"""Share of the brightest region; darker regions are not brightened fully, or noise in air would become structure."""


def detail_inside(image: Image, mask: NDArray[np.bool_], spacing_mm: Array) -> float:
    """Detail in most sections of a mask: standard deviation of the image between noise and coarse structure.

    Args:
        image: [I, J, K] stack in any units, slices along the last axis.
        mask: [I, J, K] region to measure; its outermost millimetres are ignored.
        spacing_mm: [3].

    Returns:
        Median over the sections, relative to the local brightness; NaN if too few sections are large enough.
    """
    if not mask.any():
        return float("nan")
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    box = bounding_box(mask)
    # a margin of one unmasked pixel, also at the edge of the field of view
    within = np.pad(mask[box], [(1, 1), (1, 1), (0, 0)])
    values = np.pad(image[box], [(1, 1), (1, 1), (0, 0)]) * within
    fine, coarse = (_mean_within(values, within, mm, spacing) for mm in (NOISE_MM, COARSE_MM))
    detail = []
    for k in range(within.shape[2]):
        inner = distance_transform_edt(within[:, :, k], sampling=spacing[:2]) > SKIN_MM
        if inner.sum() * spacing[0] * spacing[1] >= MIN_INNER_MM2:
            around = np.maximum(coarse[:, :, k][inner], 1e-12)
            detail.append(float(np.std((fine[:, :, k][inner] - around) / around)))
    return float(np.median(detail)) if len(detail) >= MIN_SECTIONS else float("nan")


def evened(image: Image, spacing_mm: Array) -> Image:
    """A stack with regions of about equal brightness, so that shading and signal folded over it count less.

    Args:
        image: [I, J, K], non-negative; slices along the last axis.
        spacing_mm: [3].
    """
    sigma = [EVEN_MM / spacing_mm[0], EVEN_MM / spacing_mm[1], 0]
    around = gaussian_filter(image, sigma)
    floor = DARKEST_SHARE * float(around.max())
    return image / np.maximum(around, floor) if floor > 0 else image


def _mean_within(values: Image, within: NDArray[np.bool_], sigma_mm: float, spacing: Array) -> Image:
    """In-plane Gaussian mean over the pixels of a mask alone; `values` are zero elsewhere."""
    sigma = [sigma_mm / spacing[0], sigma_mm / spacing[1], 0]
    weight = gaussian_filter(within.astype(np.float32), sigma)
    return gaussian_filter(values, sigma) / np.maximum(weight, 1e-6)
