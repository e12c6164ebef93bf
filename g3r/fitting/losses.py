"""Terms of the losses of both stages (G3R Eq. 8 and 9)."""

from __future__ import annotations

import torch
from torch import Tensor


def weighted_l1(prediction: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Sum of weight |prediction - target| over the sum of weights; zero where nothing counts.

    Args:
        prediction: [P].
        target: [P].
        weight: [P], not negative; zero leaves a pixel out.
    """
    total = weight.sum()
    return (weight * (prediction - target).abs()).sum() / total.clamp_min(torch.finfo(weight.dtype).tiny)


def scale_regulariser(log_scale: Tensor, seed_log_scale: Tensor) -> Tensor:
    """Mean squared logarithm of how far each sigma has gone from its seed: a pure number.

    Keeps Gaussians that few pixels see from shrinking to needles or growing over the head.
    """
    return (log_scale - seed_log_scale).square().mean()
