"""What a stack must be, in shape, header, slice profile and intensities; each check says what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.psf import IN_PLANE_FWHM_RANGE_PIXELS, THICKNESS_RANGE_MM
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

ORTHOGONALITY_TOLERANCE = 1e-3
"""Largest cosine between two axes of a stack; headers of scanners keep about 1e-5."""

SPACING_RANGE_MM = (0.05, 50.0)
"""Allowed spacing of pixels and slices; headers in metres or micrometres are outside."""

INTENSITY_RANGE = (1e-30, 1e30)
"""Allowed range of the largest value inside a mask, so that float32 can be divided by it."""

MAX_NEGATIVE_SHARE = 0.1
"""Largest share of masked values that may be negative: filters leave a few, a mean of zero half of all."""

MIN_POSITIVE_SHARE = 0.01
"""Smallest share of masked values that must be positive: intensities are normalised by their 99th percentile."""


def spaced(lengths: NDArray[np.float64]) -> str:
    """Lengths for messages, such as 0.8 x 0.8 x 3."""
    return " x ".join(f"{x:.3g}" for x in lengths)


def check_arrays(image: NDArray[np.float32], mask: NDArray[np.bool_], name: str) -> None:
    """Raise `InputError` unless image and mask are one stack of two slices or more, with a brain."""
    if image.ndim != 3:
        raise InputError(f"{name}: has shape {image.shape}; expected a 3D stack of slices")
    if mask.shape != image.shape:
        raise InputError(f"{name}: mask has shape {mask.shape}, image {image.shape}; expected the same")
    if image.shape[2] < 2:
        raise InputError(f"{name}: holds {image.shape[2]} slice; expected a stack of at least 2")
    if not mask.any():
        raise InputError(f"{name}: mask is empty; expected the brain to be marked")


def check_grid(shape: tuple[int, ...], affine: NDArray[np.float64], name: str) -> None:
    """Raise `InputError` unless an affine [4, 4] has orthogonal axes and voxels that can be in mm."""
    try:
        grid = VolumeGrid((shape[0], shape[1], shape[2]), affine)
    except ValueError as error:
        raise InputError(f"{name}: bad header ({error}); fix the sform or qform") from None
    spacing, shear = grid.spacing_mm, grid.shear
    low, high = SPACING_RANGE_MM
    if not (low <= spacing.min() and spacing.max() <= high):
        raise InputError(
            f"{name}: voxels of {spaced(spacing)} mm; expected {low:g} to {high:g} mm, check the header (units, "
            "pixdim, sform)"
        )
    if shear > ORTHOGONALITY_TOLERANCE:
        raise InputError(f"{name}: axes are sheared (cosine {shear:.2g}); resample to orthogonal axes")


def check_profile(thickness_mm: float, in_plane_fwhm_pixels: Sequence[float], name: str) -> None:
    """Raise `InputError` unless thickness and in-plane FWHM are within their ranges."""
    low, high = THICKNESS_RANGE_MM
    if not (np.isfinite(thickness_mm) and low <= thickness_mm <= high):
        raise InputError(
            f"{name}: slice thickness {thickness_mm:g} mm; expected {low:g} to {high:g} mm, pass --thickness"
        )
    low, high = IN_PLANE_FWHM_RANGE_PIXELS
    if len(in_plane_fwhm_pixels) != 2 or not all(low <= width <= high for width in in_plane_fwhm_pixels):
        raise InputError(
            f"{name}: in-plane FWHM of {in_plane_fwhm_pixels} pixels; expected two numbers from {low:g} to {high:g}, "
            "for the two axes of a slice"
        )


def check_intensities(image: NDArray[np.float32], mask: NDArray[np.bool_], name: str) -> None:
    """Raise `InputError` unless the values inside a mask that is not empty are those of a magnitude image."""
    inside = image[mask]
    n_bad = int((~np.isfinite(inside)).sum())
    if n_bad:
        raise InputError(f"{name}: {n_bad} values inside the mask are not finite; repair or mask them out")
    if inside.size > 1 and inside.min() == inside.max():
        raise InputError(f"{name}: every value inside the mask is {inside[0]:g}; expected an image")
    if np.count_nonzero(inside > 0) < MIN_POSITIVE_SHARE * inside.size:
        raise InputError(
            f"{name}: hardly a value inside the mask is positive (the largest is {inside.max():g}); expected a "
            "magnitude image"
        )
    acquired = image[mask & ((image > 0) & mask).any((0, 1))]  # a blank slice may be of a negative value
    negative = np.count_nonzero(acquired < 0) / max(acquired.size, 1)
    if negative > MAX_NEGATIVE_SHARE:
        raise InputError(
            f"{name}: {100 * negative:.0f} % of the values inside the mask are negative; expected a magnitude image, "
            "pass it as it was before its mean was subtracted"
        )
    low, high = INTENSITY_RANGE
    if not low <= inside.max() <= high:
        raise InputError(
            f"{name}: largest value inside the mask is {inside.max():g}; expected {low:g} to {high:g}, scale the image"
        )
