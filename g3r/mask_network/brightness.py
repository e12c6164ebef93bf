"""What brightness alone says of a stack: how much detail a part of it shows, and the stack with even brightness."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from g3r.geometry.grid import bounding_box

Image = NDArray[np.float32]
Array = NDArray[np.floating]

NOISE_MM, COARSE_MM = 2.0, 6.0
"""Standard deviations in the plane: detail is what lies between noise, and shading and large parts."""
SKIN_MM = 5.0
"""Outermost part of a section that does not count: its edge is no detail."""
MIN_INNER_MM2 = 200.0
"""Sections of which less is left are not judged."""
MIN_SECTIONS = 3
"""Fewer do not tell."""
EVEN_MM = 25.0
"""Standard deviation of the smoothing in the plane that evens brightness: less than a head, more than its parts."""
DARKEST_SHARE = 0.1
"""Of the brightest region; what is darker is not made brighter, or noise in air would look like something."""


def detail_inside(image: Image, mask: NDArray[np.bool_], spacing_mm: Array) -> float:
    """How much detail most sections of a mask show: standard deviation of what is neither noise nor coarse.

    Args:
        image: [I, J, K] stack in any units, slices along the last axis.
        mask: [I, J, K] where to look; its outermost millimetres do not count.
        spacing_mm: [3].

    Returns:
        Median over the sections, as a share of the brightness about each pixel; NaN where too few are large enough.
    """
    if not mask.any():
        return float("nan")
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    box = bounding_box(mask)
    # a margin of one pixel that is no mask, also where the field of view ends
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
    """A stack whose regions are about equally bright: shading, and what folded over a part of it, count less.

    Args:
        image: [I, J, K], not negative; slices along the last axis.
        spacing_mm: [3].
    """
    sigma = [EVEN_MM / spacing_mm[0], EVEN_MM / spacing_mm[1], 0]
    around = gaussian_filter(image, sigma)
    floor = DARKEST_SHARE * float(around.max())
    return image / np.maximum(around, floor) if floor > 0 else image


def _mean_within(values: Image, within: NDArray[np.bool_], sigma_mm: float, spacing: Array) -> Image:
    """Gaussian mean in the plane over the pixels of a mask alone; `values` are zero elsewhere."""
    sigma = [sigma_mm / spacing[0], sigma_mm / spacing[1], 0]
    weight = gaussian_filter(within.astype(np.float32), sigma)
    return gaussian_filter(values, sigma) / np.maximum(weight, 1e-6)
