"""How much of k-space was filled, from the spectrum of slices: images are often interpolated to smaller pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

N_FREQUENCIES = 100
"""Frequencies, evenly spaced from 0 to the highest of the pixels, at which the spectrum is compared."""

LOWEST, HIGHEST = 0.2, 0.9
"""Shares that are looked for. Scanners round off the ends of k-space from 0.9 on."""

FEWEST_PIXELS = 64
"""Along an axis; fewer have too few frequencies."""

SMOOTH = 0.015
"""Smoothing of the logarithm of power, as a share of the highest frequency."""

NEAR, FAR = 0.05, 0.12
"""Distances from the end, on either side, between which power is averaged to find a step."""

STEP = 1.45
"""Least step of the decimal logarithm of power. Over such distances the power of simulated heads falls by up to 1.2
(200 axes), that of three real stacks by 0.8; at the end of k-space theirs falls by 1.7 to 1.9, and that of heads that
were zero-filled by more."""

HALF_AMPLITUDE = 2 * np.log10(2)


def filled_share(image: NDArray[np.floating], axis: int) -> float | None:
    """Share of k-space that was filled along an axis; None where its spectrum shows no end.

    The end is where the amplitude has fallen to a half, so that a filter of the scanner counts. The spectrum of images
    that were cut out, resampled in another grid or filtered since shows no end.

    Args:
        image: [I, J, K] slices along the third axis, with what surrounds the head.
        axis: 0 or 1.
    """
    if image.shape[axis] < FEWEST_PIXELS or not np.any(image[np.isfinite(image)]):
        return None
    level = _log_power(image, axis)
    frequency = np.arange(N_FREQUENCIES) / N_FREQUENCIES
    steps = np.array([_step(level, frequency - end) for end in frequency])
    steps[(frequency < LOWEST) | (frequency > HIGHEST)] = 0
    if steps.max() < STEP:
        return None
    # images may be filtered first and interpolated later: the first of several ends counts
    first = int(np.argmax(steps >= STEP))
    end = first + int(np.argmax(steps[first : first + round(2 * FAR * N_FREQUENCIES)]))
    start = max(0, end - round(FAR * N_FREQUENCIES))
    inside = level[start : end - round(NEAR * N_FREQUENCIES)].mean()
    if level[frequency >= frequency[end] + FAR].max(initial=-np.inf) > inside - STEP:
        return None
    return round(float(frequency[start + int(np.argmax(level[start:] < inside - HALF_AMPLITUDE))]), 3)


def _step(level: NDArray[np.float64], distance: NDArray[np.float64]) -> float:
    """Fall of the spectrum over the frequency at distance 0; 0 near its ends."""
    inside, outside = (distance >= -FAR) & (distance <= -NEAR), (distance >= NEAR) & (distance <= FAR)
    return float(level[inside].mean() - level[outside].mean()) if inside.any() and outside.any() else 0.0


def _log_power(image: NDArray[np.floating], axis: int) -> NDArray[np.float64]:
    """Decimal logarithm of power at `N_FREQUENCIES` frequencies along an axis, of all lines and slices."""
    power = np.zeros(image.shape[axis] // 2 + 1)
    scale = float(np.abs(image[np.isfinite(image)]).max())
    for one in np.moveaxis(image, 2, 0):  # slice by slice, so that little memory is needed
        lines = np.moveaxis(np.where(np.isfinite(one), one, 0) / np.float64(scale), axis, 1)
        spectrum = np.fft.rfft((lines - lines.mean(1, keepdims=True)) * np.hanning(lines.shape[1]), axis=1)
        power += (spectrum.real**2 + spectrum.imag**2).sum(0)
    floor = max(float(power.max()) * 1e-12, np.finfo(np.float64).tiny)
    at = np.arange(N_FREQUENCIES) / N_FREQUENCIES * (len(power) - 1)
    level = np.interp(at, np.arange(len(power)), np.log10(np.maximum(power, floor)))
    return np.asarray(gaussian_filter1d(level, SMOOTH * N_FREQUENCIES, mode="nearest"))
