"""Images that were set to zero beyond their masks, as brain extraction leaves them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from g3r.acquisition.planes import Slices

MOSTLY = 0.9
"""Share of the pixels beside its mask from which on a stack is cut: simulated stacks of a head in black have no zeros
there, or a few where they have no noise, since these pixels are partly brain; masked ones have nothing else."""


def cut_at_mask(slices: Slices) -> NDArray[np.bool_]:
    """Whether the stack of each slice was set to zero beyond its mask [K].

    What is zero there was not measured: pixels whose middle lies just outside the mask hold brain, too.
    """
    beside, zero = np.zeros(len(slices)), np.zeros(len(slices))
    for k, (shape, start) in enumerate(zip(slices.planes.shape, slices.planes.offset[:-1], strict=True)):
        pixels = slice(start, start + int(shape.prod()))
        mask, value = (one[pixels].reshape(shape) for one in (slices.mask, slices.value))
        rim = value[binary_dilation(mask) & ~mask]
        beside[k], zero[k] = len(rim), np.count_nonzero(rim == 0)
    _, stack = np.unique(slices.stack_id, return_inverse=True)
    n_beside, n_zero = (np.bincount(stack, one) for one in (beside, zero))
    return (n_zero > MOSTLY * n_beside)[stack]
