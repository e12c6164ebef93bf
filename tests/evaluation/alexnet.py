"""AlexNet with random weights, since the formula of LPIPS does not depend on the weights."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

CHANNELS, SIDES, INPUTS, PLACES = (64, 192, 384, 256, 256), (11, 5, 3, 3, 3), (3, 64, 192, 384, 256), (0, 3, 6, 8, 10)


def random_states(seed: int = 0) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Features and heads of the right shapes."""
    g = torch.Generator().manual_seed(seed)
    features: dict[str, Tensor] = {}
    for n, c, i, k in zip(PLACES, CHANNELS, INPUTS, SIDES, strict=True):
        features[f"features.{n}.weight"] = torch.randn(c, i, k, k, generator=g) / (i * k * k) ** 0.5
        features[f"features.{n}.bias"] = torch.randn(c, generator=g) / 10
    heads = {f"lin{n}.model.1.weight": torch.rand(1, c, 1, 1, generator=g) for n, c in enumerate(CHANNELS)}
    return features, heads


def save_states(folder: Path) -> None:
    """Write both files in the formats of torchvision and of the authors."""
    features, heads = random_states()
    torch.save(features, folder / "alexnet-owt-7be5be79.pth")
    torch.save(heads, folder / "alex.pth")
