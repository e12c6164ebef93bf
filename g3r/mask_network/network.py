"""A U-Net of MONAI's blocks that segments brain in a stack, at either of two pixel sizes."""

from collections.abc import Sequence

import torch
from monai.networks.blocks.dynunet_block import UnetBasicBlock, UnetOutBlock, UnetUpBlock
from torch import Tensor, nn
from torch.nn import functional

from g3r.checkpoints.device import is_bfloat16_fast
from g3r.mask_network.config import MaskNetworkConfig

BRIGHT_SHARE = 0.99
"""Quantile of an image that serves as its unit of intensity."""
N_FLAT_LEVELS = 2
"""Levels with kernels within a slice; the deeper ones also see neighbouring slices."""
_NORM = ("INSTANCE", {"affine": True})  # intensities and contrasts differ from scan to scan


class MaskNetwork(nn.Module):
    """Network that finds the fetal brain in a whole stack with large pixels, and outlines it in a crop with small ones.

    Both use one set of weights: heads of 38 weeks are twice as large as those of 19, so the network has to know all
    sizes anyway, and what it learns about the surroundings of heads serves both.

    Args:
        config: see `MaskNetworkConfig`.
    """

    def __init__(self, config: MaskNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.unet = SubpixelUNet(config.channels, (2, 2, 1), N_FLAT_LEVELS)

    def forward(self, image: Tensor) -> Tensor:
        """Logits of brain in stacks or crops [B, 1, I, J, K] of K slices, in any units."""
        return self.unet(normalised(image))


class SubpixelUNet(nn.Module):
    """A U-Net that turns pixels into channels first, because a CPU spends most of its time at full resolution.

    Args:
        channels: feature channels of the levels.
        factor: pixels per axis that become channels; also the stride from a level to the next.
        n_flat: number of first levels with kernels within a slice.
    """

    def __init__(self, channels: Sequence[int], factor: tuple[int, int, int], n_flat: int) -> None:
        super().__init__()
        self.factor = factor
        self.n_levels = len(channels)
        n_pixels = factor[0] * factor[1] * factor[2]
        kernels = [(3, 3, 1) if level < n_flat else (3, 3, 3) for level in range(len(channels))]
        self.down = nn.ModuleList()
        for level, width in enumerate(channels):
            into = channels[level - 1] if level else n_pixels
            stride = factor if level else (1, 1, 1)
            self.down.append(UnetBasicBlock(3, into, width, kernels[level], stride, _NORM))
        self.up = nn.ModuleList(
            UnetUpBlock(3, channels[level + 1], channels[level], kernels[level], 1, factor, _NORM)
            for level in range(len(channels) - 1)
        )
        self.out = UnetOutBlock(3, channels[0], n_pixels)

    def forward(self, image: Tensor) -> Tensor:
        """Return logits [B, 1, I, J, K] of images of that shape; any size works, because it pads with zeros."""
        size = image.shape[2:]
        strides = [f**self.n_levels for f in self.factor]
        far_end = [
            padding
            for extent, stride in zip(size[::-1], strides[::-1], strict=True)
            for padding in (0, -extent % stride)
        ]
        # bfloat16 halves the time of a training step; inference computes in float32
        short = self.training and is_bfloat16_fast(image.device.type)
        with torch.autocast(image.device.type, torch.bfloat16, enabled=short):
            features = to_channels(functional.pad(image, far_end), self.factor)
            features = features.contiguous(memory_format=torch.channels_last_3d)
            skips = []
            for down in self.down:
                features = down(features)
                skips.append(features)
            skips.pop()
            for up in reversed(self.up):
                features = up(features, skips.pop())
            logits = to_pixels(self.out(features), self.factor)
        return logits[:, :, : size[0], : size[1], : size[2]].float()


def normalised(image: Tensor) -> Tensor:
    """Images [B, 1, I, J, K] in units of their bright quantile: from 0 to about 1, and at most 2."""
    flat = image.flatten(1).float()
    rank = max(1, int(BRIGHT_SHARE * flat.shape[1]))
    # no division by zero: a black image stays black
    bright = flat.kthvalue(rank, dim=1).values.clamp_min(torch.finfo(torch.float32).tiny)
    scaled = image.float() / bright[:, None, None, None, None]
    return scaled.clamp(0.0, 2.0)


def to_channels(image: Tensor, factor: tuple[int, int, int]) -> Tensor:
    """Blocks of pixels as channels: [B, 1, I, J, K] to [B, F, I / f0, J / f1, K / f2] with F = f0 f1 f2."""
    b, _, i, j, k = image.shape
    f0, f1, f2 = factor
    split = image.reshape(b, i // f0, f0, j // f1, f1, k // f2, f2)
    return split.permute(0, 2, 4, 6, 1, 3, 5).reshape(b, f0 * f1 * f2, i // f0, j // f1, k // f2)


def to_pixels(features: Tensor, factor: tuple[int, int, int]) -> Tensor:
    """The inverse of `to_channels`."""
    b, _, i, j, k = features.shape
    f0, f1, f2 = factor
    split = features.reshape(b, f0, f1, f2, i, j, k)
    return split.permute(0, 4, 1, 5, 2, 6, 3).reshape(b, 1, i * f0, j * f1, k * f2)
