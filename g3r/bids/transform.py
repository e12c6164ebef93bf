"""Rigid transforms in ITK's text format."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from g3r.geometry.lps import LPS_FROM_RAS


def itk_text(standard_from_scanner: Sequence[Sequence[float]]) -> str:
    """The text of a transform that resamples images of the scanner's space into standard orientation.

    ITK resamples by looking up each point of the new image in the old one, so the file maps points of the standard
    space to the scanner's.

    Args:
        standard_from_scanner: [4, 4] rigid motion of points, RAS in mm.
    """
    scanner_from_standard = np.linalg.inv(np.asarray(standard_from_scanner, dtype=np.float64))
    matrix = LPS_FROM_RAS @ scanner_from_standard @ LPS_FROM_RAS
    numbers = [*matrix[:3, :3].ravel(), *matrix[:3, 3]]
    return (
        "#Insight Transform File V1.0\n"
        "#Transform 0\n"
        "Transform: AffineTransform_double_3_3\n"
        f"Parameters: {' '.join(f'{x:.12g}' for x in numbers)}\n"
        "FixedParameters: 0 0 0\n"
    )
