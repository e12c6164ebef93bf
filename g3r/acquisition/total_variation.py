"""Total variation on voxels: smooth where little changes, and sharp at edges.

It is minimised as a sequence of weighted squares (lagged diffusivity, Vogel and Oman 1996): the weights of one round
follow from the volume of the round before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.kernels_voxels import fill_divergence

Float32Array = NDArray[np.float32]


def diffusivity(volume: Float32Array, tip: float) -> Float32Array:
    """1 / (2 |grad V|) of total variation with a rounded tip [I, J, K].

    Args:
        volume: [I, J, K].
        tip: length of the gradient, from voxel to voxel, below which total variation is rounded off.
    """
    squares = np.zeros_like(volume)
    for axis in range(3):
        squares += np.diff(volume, axis=axis, append=np.take(volume, [-1], axis)) ** 2
    return (0.5 / np.sqrt(squares + np.float32(tip) ** 2)).astype(np.float32)


def divergence_of_gradient(volume: Float32Array, weight: Float32Array | None) -> Float32Array:
    """D^T W D V with forward differences D, free edges, and the weights W [I, J, K] of voxels (None: 1)."""
    out = np.empty_like(volume)
    fill_divergence(volume, np.ones((1, 1, 1), volume.dtype) if weight is None else weight, weight is not None, out)
    return out
