"""Fast smooth noise on large grids: drawn on a coarse lattice and interpolated linearly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.axis_resampling import along_axes, axis_weights


def lattice_noise(shape: tuple[int, ...], step: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Noise of about unit variance with a correlation length of about `step` voxels.

    Args:
        shape: [I, J, K] of the grid.
        step: spacing of the lattice points in voxels, at least 1.
        rng: source of randomness.
    """
    size = tuple(int(np.ceil(n / step)) + 2 for n in shape)
    lattice = rng.normal(0, 1.5 if step > 1.5 else 1.0, size).astype(np.float32)
    at = [np.arange(n) + float(rng.uniform(0, step)) for n in shape]
    return along_axes(lattice, [axis_weights(m, step, a, 1.0) for m, a in zip(size, at, strict=True)])
