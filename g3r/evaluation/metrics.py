"""Image scores inside a mask: PSNR, SSIM, NCC and RMSE after an affine fit of the intensities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from g3r.geometry.grid import bounding_box

PSNR_CAP_DB = 100.0
"""PSNR reported if the volumes agree to float32 rounding; it keeps infinity out of tables and JSON."""

RANGE_PERCENTILE = 99.9
"""The data range is this percentile of the reference in the mask, so that a few bright voxels do not set it."""

SSIM_WINDOW_VOXELS = 7


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores over the voxels of a mask.

    Attributes:
        psnr_db: peak signal-to-noise ratio, at most `PSNR_CAP_DB`.
        ssim: structural similarity, mean of its local map over the mask.
        ncc: correlation coefficient; 0 if one of the two is constant.
        rmse: root mean squared error as a fraction of the data range.
        gain: factor that was applied to the volume, in reference units per volume unit.
        offset: constant that was added afterwards, in reference units.
        data_range: reference intensity that counts as 1.
        n_voxels: voxels in the mask.
    """

    psnr_db: float
    ssim: float
    ncc: float
    rmse: float
    gain: float
    offset: float
    data_range: float
    n_voxels: int


def fit_intensity(
    volume: NDArray[np.floating], reference: NDArray[np.floating], mask: NDArray[np.bool_]
) -> tuple[float, float]:
    """Gain and offset that bring a volume nearest to the reference in the mask (least squares).

    A reconstruction has an arbitrary intensity scale, which scores should not depend on. A constant volume
    gets gain 0.

    Args:
        volume: [I, J, K].
        reference: [I, J, K].
        mask: [I, J, K].
    """
    x = volume[mask].astype(np.float64)
    y = reference[mask].astype(np.float64)
    x_mean, y_mean = x.mean(), y.mean()
    variance = ((x - x_mean) ** 2).mean()
    # relative bound: a constant float32 image keeps a variance of rounding size
    if variance <= (1e-7 * max(abs(x_mean), np.abs(x).max())) ** 2:
        return 0.0, float(y_mean)
    gain = float(((x - x_mean) * (y - y_mean)).mean() / variance)
    return gain, float(y_mean - gain * x_mean)


def score(volume: NDArray[np.floating], reference: NDArray[np.floating], mask: NDArray[np.bool_]) -> Scores:
    """Compare a volume with the reference on one grid [I, J, K], inside the mask.

    The reference is divided by its `RANGE_PERCENTILE` in the mask, the volume is fitted to it affinely,
    and both are set to zero outside the mask, so that they agree in SSIM windows at its edge.

    Args:
        volume: [I, J, K].
        reference: [I, J, K].
        mask: [I, J, K].

    Raises:
        ValueError: shapes differ, the mask is empty, a value in the mask is not finite, or the reference
            is not positive anywhere in the mask.
    """
    if not volume.shape == reference.shape == mask.shape:
        raise ValueError(f"shapes differ: volume {volume.shape}, reference {reference.shape}, mask {mask.shape}")
    if not mask.any():
        raise ValueError("the mask is empty")
    if not (np.isfinite(volume[mask]).all() and np.isfinite(reference[mask]).all()):
        raise ValueError("values in the mask are not finite")
    data_range = float(np.percentile(reference[mask].astype(np.float64), RANGE_PERCENTILE))
    if data_range <= 0:
        raise ValueError(f"the reference's {RANGE_PERCENTILE}th percentile in the mask is {data_range:.3g}")
    gain, offset = fit_intensity(volume, reference, mask)
    box = bounding_box(mask, SSIM_WINDOW_VOXELS // 2)  # every window centred in the mask
    inside = mask[box]
    truth = np.where(inside, reference[box].astype(np.float64) / data_range, 0.0)
    fitted = np.where(inside, (volume[box].astype(np.float64) * gain + offset) / data_range, 0.0)
    rmse = float(np.sqrt(((fitted - truth)[inside] ** 2).mean()))
    return Scores(
        psnr_db=psnr_db(rmse),
        ssim=mean_ssim(fitted, truth, inside),
        ncc=correlation(fitted[inside], truth[inside]) if gain else 0.0,
        rmse=rmse,
        gain=gain,
        offset=offset,
        data_range=data_range,
        n_voxels=int(mask.sum()),
    )


def psnr_db(rmse: float) -> float:
    """PSNR of an error given as a fraction of the data range."""
    return PSNR_CAP_DB if rmse <= 10 ** (-PSNR_CAP_DB / 20) else float(-20 * np.log10(rmse))


def mean_ssim(volume: NDArray[np.float64], truth: NDArray[np.float64], mask: NDArray[np.bool_]) -> float:
    """Mean over the mask of the local structural similarity, data range 1 (Wang et al. 2004)."""
    short = [max(0, SSIM_WINDOW_VOXELS - n) for n in truth.shape]
    pad = [(0, n) for n in short]
    _, similarity = structural_similarity(
        np.pad(truth, pad), np.pad(volume, pad), data_range=1.0, win_size=SSIM_WINDOW_VOXELS, full=True
    )
    return float(similarity[np.pad(mask, pad)].mean())


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Correlation coefficient of two samples; 0 if one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / norm if norm > 0 else 0.0
