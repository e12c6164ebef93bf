"""What the mask network says of an image and of its mirror images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Flip = tuple[int, ...]
"""Axes of a tensor [1, 1, I, J, K] along which an image is mirrored; none for the image itself."""

FLIPS: tuple[Flip, ...] = ((), (2, 3))
"""The image as it is, and turned by 180 degrees in the plane."""
FURTHER_FLIPS: tuple[Flip, ...] = ((2,), (3,))
"""Mirrored once in the plane."""


def brain_probability(
    logits_of: Callable[[Tensor], Tensor], image: NDArray[np.float32], flips: Sequence[Flip]
) -> list[NDArray[np.float32]]:
    """Probability [I, J, K] of brain as each mirror image shows it, turned back.

    Args:
        logits_of: the network.
        image: [I, J, K].
        flips: mirror images to look at.
    """
    tensor = torch.from_numpy(np.ascontiguousarray(image))[None, None]
    with torch.inference_mode():
        return [torch.sigmoid(logits_of(tensor.flip(axes))).flip(axes)[0, 0].numpy() for axes in flips]
