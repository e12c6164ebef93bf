"""The PSF of a slice (its slice profile): a Gaussian in the frame of the slice."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FWHM_PER_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
"""Full width at half maximum of a Gaussian in units of its sigma (2.3548)."""

IN_PLANE_FWHM_PIXELS = 1.2
"""In-plane FWHM in pixels, of a single-shot sequence (Kuklisova-Murgasova et al., MedIA 2012)."""

THICKNESS_RANGE_MM = (0.1, 20.0)
"""Allowed slice thickness."""

IN_PLANE_FWHM_RANGE_PIXELS = (0.1, 20.0)
"""Allowed in-plane FWHM."""


def psf_variance_mm2(
    spacing_mm: ArrayLike, thickness_mm: ArrayLike, in_plane_fwhm_pixels: ArrayLike = IN_PLANE_FWHM_PIXELS
) -> NDArray[np.float64]:
    """Variances of the Gaussian PSF along the slice's own axes (x, y in plane, z through it).

    Args:
        spacing_mm: [..., 2] in-plane pixel spacing.
        thickness_mm: [...] slice thickness (not the distance of slices: there are gaps).
        in_plane_fwhm_pixels: one number, or [..., 2] of each axis, see `partial_fwhm_pixels`.

    Returns:
        [..., 3] in mm^2.

    Source: Kuklisova-Murgasova et al., Medical Image Analysis 16 (2012): FWHM 1.2 pixels in plane,
        the slice thickness through plane.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    thickness = np.asarray(thickness_mm, dtype=np.float64)
    fwhm_pixels = np.asarray(in_plane_fwhm_pixels, dtype=np.float64)
    fwhm_mm = np.concatenate([fwhm_pixels * spacing, thickness[..., None]], axis=-1)
    return (fwhm_mm / FWHM_PER_SIGMA) ** 2


def partial_fwhm_pixels(filled_share: float) -> float:
    """In-plane FWHM in pixels along an axis of k-space that was filled in part: 1.2 / p.

    With pixels of d mm, k-space is filled up to p / (2 d) along this axis and zero beyond. So the image of a point is
    sin(pi p x / d) / (pi p x / d). Its main lobe is half as high at x = 0.603 d / p: its FWHM is 1.207 d / p. For
    p = 1 these are the nominal 1.2 pixels, and the Gaussian's FWHM grows with 1 / p as that of the lobe does.

    Args:
        filled_share: p, above 0 and up to 1: the phase resolution, or what interpolation to smaller pixels left.
    """
    return IN_PLANE_FWHM_PIXELS / filled_share
