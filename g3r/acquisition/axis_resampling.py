"""Resampling of a volume along its own axes: one small matrix per axis, smoothed where the new samples are coarser."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def axis_weights(n: int, spacing_mm: float, at_mm: NDArray[np.floating], new_spacing_mm: float) -> NDArray[np.float32]:
    """Weights that resample n samples, by a hat as wide as the coarser of the two spacings.

    Values beyond the samples count as zero.

    Args:
        n: number of samples N.
        spacing_mm: between them.
        at_mm: [M] positions of the new samples, from the first sample.
        new_spacing_mm: spacing of the new samples.

    Returns:
        [M, N].
    """
    width = max(spacing_mm, new_spacing_mm)
    beyond = int(np.ceil(width / spacing_mm)) + 1
    first = np.floor(np.asarray(at_mm) / spacing_mm).astype(np.int64)[:, None]
    index = first + np.arange(-beyond, beyond + 2)
    weight = np.maximum(1 - np.abs(index * spacing_mm - np.asarray(at_mm)[:, None]) / width, 0)
    weight /= weight.sum(1, keepdims=True)
    result = np.zeros((len(at_mm), n))
    row, column = np.nonzero((index >= 0) & (index < n))
    result[row, index[row, column]] = weight[row, column]
    return result.astype(np.float32)


def along_axes(volume: NDArray[np.float32], weights: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """A volume resampled along each axis.

    Args:
        volume: [I, J, K].
        weights: three of [new, old], see `axis_weights`.

    Returns:
        [I', J', K'].
    """
    for axis, weight in enumerate(weights):
        volume = np.moveaxis(np.tensordot(weight, volume, axes=(1, axis)), 0, axis)
    return np.ascontiguousarray(volume, dtype=np.float32)


def centred_positions_mm(n: int, spacing_mm: float, n_old: int, old_spacing_mm: float) -> NDArray[np.floating]:
    """Positions [n] of new samples centred on the old ones, measured from the first old sample (mm).

    Args:
        n: new samples.
        spacing_mm: between them.
        n_old: old samples.
        old_spacing_mm: between those.
    """
    return (np.arange(n) - (n - 1) / 2) * spacing_mm + (n_old - 1) / 2 * old_spacing_mm
