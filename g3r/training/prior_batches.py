"""Batches of the prior's training: their form, their symmetries and their loss."""

from collections.abc import Mapping

import torch
from torch import Tensor

Batch = Mapping[str, Tensor]
"""{"coarse", "density", "sharp", "truth", "mask"}, each float32 [B, 1, I, J, K], intensities "p99-coarse-v1".

`n_stacks`, int64 [B], is optional: scores are also logged by the number of stacks where it is there. Other
entries are left as they are."""


def loss_weight(mask: Tensor, background_weight: float) -> Tensor:
    """Return 1 in the mask and `background_weight` elsewhere, [B, 1, I, J, K]."""
    return background_weight + (1.0 - background_weight) * (mask > 0.5).to(mask.dtype)


def weighted_l1(volume: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return sum(w |V - truth|) / sum(w), a scalar.

    Args:
        volume: V, [B, 1, I, J, K].
        truth: of the same shape.
        weight: w >= 0, of the same shape.
    """
    return (weight * (volume - truth).abs()).sum() / weight.sum().clamp_min(torch.finfo(weight.dtype).tiny)


def random_cube_symmetry(batch: Batch) -> dict[str, Tensor]:
    """Return the batch mirrored and rotated by one random symmetry of its grid (48 of a cube).

    Axes are exchanged only among those of equal extent, so the shape stays the same. The random numbers are
    torch's global ones, which Lightning seeds.
    """
    shape = batch["truth"].shape[2:]
    order = torch.randperm(3).tolist()
    if [shape[axis] for axis in order] != list(shape):
        order = [0, 1, 2]
    mirrored = [2 + axis for axis in range(3) if torch.rand(()) < 0.5]
    dims = [0, 1, *[2 + axis for axis in order]]
    return {
        name: value.permute(dims).flip(mirrored).contiguous() if value.ndim == 5 else value
        for name, value in batch.items()
    }
