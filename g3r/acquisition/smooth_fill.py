"""Smooth continuation of a volume into what was not measured, without knowledge of other brains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

SIGMA_VOXELS = 1.5
LEAST_WEIGHT = 0.05
"""Mean weight of the surroundings from which their mean is taken in full; below it, coarser grids fill in the rest."""

SMALLEST = 4
"""Voxels along the longest edge of the coarsest grid."""


def smooth_fill(
    values: NDArray[np.float32], weight: NDArray[np.float32], share: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """The values where they were measured, elsewhere the weighted mean of the nearest measured surroundings.

    Normalised convolution (Knutsson & Westin 1993) on grids of doubling voxels: the finest grid on which measured
    voxels are near is taken.

    Args:
        values: [I, J, K].
        weight: [I, J, K] from 0 (unknown) to 1 (measured).
        share: [I, J, K] weight of each voxel in the means of its surroundings, 0 to 1: its share of brain, so that
            voxels outside the head do not darken it; 1 when None.

    Returns:
        [I, J, K]: `weight * values + (1 - weight) * surroundings`, zero where nothing is near.
    """
    source = weight if share is None else weight * share
    around = _surroundings(source.astype(np.float32), (source * values).astype(np.float32))
    return (weight * values + (1 - weight) * around).astype(np.float32)


def _surroundings(source: NDArray[np.float32], weighted: NDArray[np.float32]) -> NDArray[np.float32]:
    """The mean of what is measured around each voxel.

    Args:
        source: [I, J, K] weights.
        weighted: [I, J, K] values times weights.
    """
    mean_weight = gaussian_filter(source, SIGMA_VOXELS)
    found = np.clip(mean_weight / LEAST_WEIGHT, 0, 1)
    mean = found * gaussian_filter(weighted, SIGMA_VOXELS) / np.maximum(mean_weight, 1e-6)
    if found.min() < 1 and max(source.shape) > SMALLEST:
        mean += (1 - found) * _doubled(_surroundings(_halved(source), _halved(weighted)), source.shape)
    return mean


def _halved(array: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of two by two by two voxels, with zeros beyond an odd end."""
    even = np.pad(array, [(0, n % 2) for n in array.shape])
    blocks = even.reshape([length for n in even.shape for length in (n // 2, 2)])
    return blocks.mean(axis=(1, 3, 5), dtype=np.float32)


def _doubled(array: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The array on voxels of half the size, cropped to a shape."""
    fine = zoom(array, 2, order=1, mode="nearest", grid_mode=True)
    return fine[tuple(slice(n) for n in shape)]
