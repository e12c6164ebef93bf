"""Scores of one slice against its prediction: error, correlation before and after a high-pass filter, similarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.psf import FWHM_PER_SIGMA
from g3r.evaluation.metrics import correlation, fit_intensity, mean_ssim

HIGH_PASS_FWHM_MM = 3.75
"""Width of the Gaussian blur that is subtracted: edges and texture remain, which a blurred volume lacks."""


@dataclass(frozen=True, kw_only=True)
class SliceScore:
    """Scores of one slice over its counted pixels, after an affine fit of the prediction's intensities.

    Attributes:
        slice_index: its number in the stack.
        n_pixels: counted pixels.
        mse: mean squared error as a share of the squared data range.
        ncc: correlation coefficient.
        high_pass_ncc: correlation coefficient of slice and prediction, each minus its own blur.
        ssim: structural similarity, mean of its local map.
    """

    slice_index: int
    n_pixels: int
    mse: float
    ncc: float
    high_pass_ncc: float
    ssim: float


def score_slice(
    predicted: NDArray[np.floating],
    observed: NDArray[np.floating],
    counted: NDArray[np.bool_],
    *,
    spacing_mm: NDArray[np.float64],
    data_range: float,
    slice_index: int,
) -> SliceScore:
    """Compare a slice with its prediction.

    Args:
        predicted: [H, W].
        observed: [H, W].
        counted: [H, W] pixels to compare; at least one.
        spacing_mm: [2] pixel spacing.
        data_range: intensity of the slice that counts as 1.
        slice_index: number of the slice, passed through.
    """
    gain, offset = fit_intensity(predicted, observed, counted)
    truth = np.where(counted, observed.astype(np.float64) / data_range, 0.0)
    fitted = np.where(counted, (predicted.astype(np.float64) * gain + offset) / data_range, 0.0)
    sigma = HIGH_PASS_FWHM_MM / FWHM_PER_SIGMA / spacing_mm
    detail = [_less_its_blur(image, counted, sigma)[counted] for image in (fitted, truth)]
    return SliceScore(
        slice_index=slice_index,
        n_pixels=int(counted.sum()),
        mse=float(((fitted - truth)[counted] ** 2).mean()),
        ncc=correlation(fitted[counted], truth[counted]),
        high_pass_ncc=correlation(*detail),
        ssim=mean_ssim(fitted, truth, counted),
    )


def _less_its_blur(
    image: NDArray[np.float64], counted: NDArray[np.bool_], sigma: NDArray[np.float64]
) -> NDArray[np.float64]:
    """An image minus its blur, which uses only the pixels of a mask."""
    weight = gaussian_filter(counted.astype(np.float64), sigma)
    return image - gaussian_filter(np.where(counted, image, 0.0), sigma) / np.maximum(weight, 1e-6)
