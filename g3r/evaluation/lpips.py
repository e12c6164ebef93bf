"""LPIPS: the distance of two images in the features of AlexNet (Zhang et al., CVPR 2018), version 0.1.

Neither torchvision nor the lpips package is needed. The weights are not part of g3r: the features are those that
torchvision trained on ImageNet, the linear heads those of the authors. Distances by other weights are not LPIPS.
"""

from __future__ import annotations

import importlib.util
import os
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from g3r.errors import InputError
from g3r.geometry.grid import bounding_box

FEATURES_NAME = "alexnet*.pth"
"""AlexNet as torchvision saves it (`alexnet-owt-7be5be79.pth` in torch's cache), or its features alone."""

HEADS_NAME = "alex.pth"

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Normalisation of the three channels, whose values are from -1 to 1."""

LEAST_PIXELS = 64
"""Smaller images are padded with black, because a stride of 4 and two poolings would leave nothing of them."""

SLICE_STEP = 3
"""Only every third slice of a volume is compared, because neighbours are nearly alike."""

LEAST_SHARE = 0.1
"""Slices with a smaller area of the mask, relative to the fullest slice, are left out: they show hardly any brain."""

HOW_TO = "give a folder with alexnet*.pth and alex.pth, or the file alexnet-owt-7be5be79.pth, by --lpips-weights"


class Lpips(nn.Module):
    """The LPIPS metric with AlexNet.

    Args:
        features: state of AlexNet, with torchvision's names (`features.0.weight` or `0.weight`).
        heads: state of the linear heads (`lin0.model.1.weight`, [1, C, 1, 1], to `lin4`).

    Raises:
        InputError: the states are not those of AlexNet and of its heads.
    """

    def __init__(self, features: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> None:
        super().__init__()
        blocks = [
            nn.Sequential(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU()),
            nn.Sequential(nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()),
            nn.Sequential(nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
            nn.Sequential(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
            nn.Sequential(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
        ]
        self.blocks = nn.ModuleList(blocks)
        plain = {name.removeprefix("features."): tensor for name, tensor in features.items()}
        convolutions = [layer for block in blocks for layer in block.children() if isinstance(layer, nn.Conv2d)]
        try:
            for layer, n in zip(convolutions, (0, 3, 6, 8, 10), strict=True):
                layer.load_state_dict({"weight": plain[f"{n}.weight"], "bias": plain[f"{n}.bias"]})
            self.heads = [heads[f"lin{n}.model.1.weight"].float() for n in range(len(self.blocks))]
            wrong = [h.shape for h, c in zip(self.heads, convolutions, strict=True) if h.numel() != c.out_channels]
        except (KeyError, RuntimeError, AttributeError) as error:
            raise InputError(f"LPIPS: not the weights of AlexNet and of its heads ({error}); {HOW_TO}") from None
        if wrong:
            raise InputError(f"LPIPS: heads of shape {tuple(wrong[0])} belong to another network; {HOW_TO}")
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, path: str | os.PathLike[str] | None = None) -> Lpips:
        """The metric with the weights of files.

        Args:
            path: a folder with both files, or a file with the features; None takes torch's cache. Heads that are not
                beside the features are taken from torchmetrics, if that is installed.

        Raises:
            InputError: there are no weights, or a file holds something else.
        """
        where = Path(torch.hub.get_dir()) / "checkpoints" if path is None else Path(path)
        found = sorted(where.glob(FEATURES_NAME)) if where.is_dir() else [where] if where.is_file() else []
        if not found:
            raise InputError(f"LPIPS: no {FEATURES_NAME} in {where}; {HOW_TO}")
        return cls(_state(found[0]), _state(_heads_beside(found[0])))

    def forward(self, one: Tensor, other: Tensor) -> Tensor:
        """Distances [B] of images [B, 3, H, W] with values from -1 to 1."""
        shift, scale = (torch.tensor(v, dtype=one.dtype)[None, :, None, None] for v in (SHIFT, SCALE))
        a, b = (one - shift) / scale, (other - shift) / scale
        total = torch.zeros(len(one), dtype=one.dtype)
        for block, head in zip(self.blocks, self.heads, strict=True):
            a, b = block(a), block(b)
            difference = (_unit(a) - _unit(b)) ** 2
            total = total + functional.conv2d(difference, head.to(one.dtype)).mean((1, 2, 3))
        return total

    def distance(self, volume: NDArray[np.floating], reference: NDArray[np.floating], mask: NDArray[np.bool_]) -> float:
        """Mean distance of the slices of two volumes on one grid: the mean of the means of three planes.

        Args:
            volume: [I, J, K], in units of the data range: 1 is white.
            reference: [I, J, K].
            mask: [I, J, K]; both are black outside it, and slices are cropped to it.
        """
        box = bounding_box(mask)
        inside = mask[box]
        pair = [np.where(inside, np.clip(one[box], 0, 1), 0).astype(np.float32) * 2 - 1 for one in (volume, reference)]
        means = []
        with torch.no_grad():
            for axis in range(3):
                one, other = (torch.from_numpy(np.stack(list(_slices(v, inside, axis)))) for v in pair)
                each = self(*(_grey(images) for images in (one, other)))
                means.append(float(each.mean()))
        return float(np.mean(means))


def _state(path: Path) -> Mapping[str, Tensor]:
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: cannot be read as weights ({str(error).splitlines()[0]}); {HOW_TO}") from None
    if not isinstance(found, Mapping):
        raise InputError(f"{path}: holds no weights; {HOW_TO}")
    return found


def _heads_beside(features: Path) -> Path:
    """The file of the heads: beside the features, or in torchmetrics, which is not imported."""
    beside = features.with_name(HEADS_NAME)
    if beside.is_file():
        return beside
    package = importlib.util.find_spec("torchmetrics")
    for folder in (package.submodule_search_locations or []) if package else []:
        shipped = Path(folder) / "functional" / "image" / "lpips_models" / HEADS_NAME
        if shipped.is_file():
            return shipped
    raise InputError(f"LPIPS: no linear heads {HEADS_NAME} beside {features}, and no torchmetrics; {HOW_TO}")


def _unit(features: Tensor) -> Tensor:
    """Features [B, C, H, W] of unit length at each pixel."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)


def _slices(volume: NDArray[np.float32], mask: NDArray[np.bool_], axis: int) -> Iterator[NDArray[np.float32]]:
    """Slices across an axis that show a fair part of the mask."""
    across = tuple(a for a in range(3) if a != axis)
    area = mask.sum(across)
    for n in np.flatnonzero(area >= max(1, LEAST_SHARE * area.max()))[::SLICE_STEP]:
        yield np.take(volume, n, axis)


def _grey(images: Tensor) -> Tensor:
    """Grey images [B, H, W] as [B, 3, H, W], padded with black to the least size."""
    height, width = (max(0, LEAST_PIXELS - n) for n in images.shape[1:])
    filled = functional.pad(images, (0, width, 0, height), value=-1.0)
    return filled[:, None].expand(-1, 3, -1, -1)
