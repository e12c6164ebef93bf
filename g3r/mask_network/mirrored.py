"""Test-time augmentation of the mask network over flips of the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Flip = tuple[int, ...]
"""Axes of a tensor [1, 1, I, J, K] along which an image is flipped; empty for the image itself."""

FLIPS: tuple[Flip, ...] = ((), (2, 3))
"""The image itself, and the image rotated by 180 degrees in the plane."""
FURTHER_FLIPS: tuple[Flip, ...] = ((2,), (3,))
"""The image flipped along one axis of the plane."""


def brain_probability(
    logits_of: Callable[[Tensor], Tensor], image: NDArray[np.float32], flips: Sequence[Flip]
) -> list[NDArray[np.float32]]:
    """Probability [I, J, K] of brain from each flip of the image, flipped back.

    Args:
        logits_of: the network.
        image: [I, J, K].
        flips: flips of the image to evaluate.
    """
    tensor = torch.from_numpy(np.ascontiguousarray(image))[None, None]
    with torch.inference_mode():
        return [torch.sigmoid(logits_of(tensor.flip(axes))).flip(axes)[0, 0].numpy() for axes in flips]
