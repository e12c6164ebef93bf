"""Total variation on voxels: smooth where little changes, and sharp at edges.

It is minimised as a sequence of weighted squares (lagged diffusivity, Vogel and Oman 1996): the weights of one round
follow from the volume of the round before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def diffusivity(volume: Array, tip: float) -> Array:
    """1 / (2 |grad V|) of total variation with a rounded tip [I, J, K].

    Args:
        volume: [I, J, K].
        tip: length of the gradient, from voxel to voxel, below which total variation is round.
    """
    squares = np.zeros_like(volume)
    for axis in range(3):
        squares += np.diff(volume, axis=axis, append=np.take(volume, [-1], axis)) ** 2
    return (0.5 / np.sqrt(squares + np.float32(tip) ** 2)).astype(np.float32)


def divergence_of_gradient(volume: Array, weight: Array | None) -> Array:
    """D^T W D V with forward differences D, free edges, and the weights W [I, J, K] of voxels (None: 1)."""
    out = np.zeros_like(volume)
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        flow = np.diff(volume, axis=axis)
        if weight is not None:
            flow = flow * weight[tuple(low)]
        out[tuple(low)] -= flow
        out[tuple(high)] += flow
    return out
