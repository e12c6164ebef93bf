"""The slice profile: a Gaussian in the frame of the slice, written once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FWHM_PER_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
"""Full width at half maximum of a Gaussian in units of its sigma (2.3548)."""

IN_PLANE_FWHM_PIXELS = 1.2
"""In-plane FWHM in pixels, of a single-shot sequence (Kuklisova-Murgasova et al., MedIA 2012)."""


def psf_variance_mm2(spacing_mm: ArrayLike, thickness_mm: ArrayLike) -> NDArray[np.float64]:
    """Variances of the Gaussian PSF along the slice's own axes (x, y in plane, z through it).

    Args:
        spacing_mm: [..., 2] in-plane pixel spacing.
        thickness_mm: [...] slice thickness (not the distance of slices: there are gaps).

    Returns:
        [..., 3] in mm^2.

    Source: Kuklisova-Murgasova et al., Medical Image Analysis 16 (2012): FWHM 1.2 pixels in plane,
        the slice thickness through plane.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    thickness = np.asarray(thickness_mm, dtype=np.float64)
    fwhm_mm = np.concatenate([IN_PLANE_FWHM_PIXELS * spacing, thickness[..., None]], axis=-1)
    return (fwhm_mm / FWHM_PER_SIGMA) ** 2
