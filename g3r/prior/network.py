"""F of Eq. 7: the residual network that refines a coarse volume, made of MONAI blocks."""

import math
from typing import Any

import torch
from monai.networks.blocks import Convolution, ResidualUnit, SubpixelUpsample
from monai.networks.utils import pixelunshuffle
from torch import Tensor, nn
from torch.nn import functional

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.inputs import PriorInputs

# No normalisation layer anywhere: instance statistics would make a voxel's value depend on how the volume
# was cut into tiles, and on how much empty background a patch has.
_LEAKY_SLOPE = 0.1
_BLOCK: dict[str, Any] = {
    "adn_ordering": "A",
    "act": ("LEAKYRELU", {"negative_slope": _LEAKY_SLOPE, "inplace": True}),
    "norm": None,
}


SLAB_ROWS = 16
"""Rows at half resolution in a slab, for which the layers at full resolution are computed at a time."""


class ResidualRefiner(nn.Module):
    """A 3D residual network F that is cheap on a CPU; its second output is the logit of a voxel being brain.

    A CPU spends most of its time at full resolution, so the network leaves it first: 2x2x2 voxels become channels
    (space to depth), and a U-shape of residual units works at 1/2, 1/4, 1/8 ... resolution. Then a sub-pixel step
    returns to full resolution, where two light convolutions see the input again.

    Densities enter as c = 1 - exp(-M) rather than as M: M is unbounded (hundreds under an output grid
    much finer than the slices), while c is in [0, 1], has slope 1 at 0, and is what the gate uses. There are two
    densities: the coverage, and the part of it whose masks say brain.

    F is bounded by tanh. With the gate, alpha is therefore the largest change by the network of a densely measured
    voxel, in units of the brightest tissue. The last convolution starts at zero, so training starts from the base.

    Args:
        config: configuration of the whole prior network, of which F uses a part.
    """

    def __init__(self, config: PriorNetworkConfig) -> None:
        super().__init__()
        self.config = config
        channels, units = config.channels, config.units

        self.stem = Convolution(3, 8 * config.n_inputs, channels[0], **_BLOCK)
        self.encoder = nn.ModuleList()
        self.down = nn.ModuleList()
        self.decoder = nn.ModuleList()
        self.up = nn.ModuleList()
        for level, (width, count) in enumerate(zip(channels, units, strict=True)):
            self.encoder.append(_residual_units(width, count))
            if level + 1 < len(channels):
                deeper = channels[level + 1]
                self.down.append(Convolution(3, width, deeper, strides=2, **_BLOCK))
                self.up.append(_subpixel_upsample(deeper, width))
                self.decoder.append(_residual_units(width, count))
        self.to_full = _subpixel_upsample(channels[0], config.tail_channels)
        self.tail = Convolution(3, config.tail_channels + config.n_inputs, config.tail_channels, **_BLOCK)
        self.head = nn.Conv3d(config.tail_channels, 2, kernel_size=3, padding=1)
        self._initialise()

    def _initialise(self) -> None:
        """Scale the weights so that activations keep their size, and F starts at exactly zero."""
        for module in self.modules():
            if isinstance(module, nn.Conv3d):
                nn.init.kaiming_normal_(module.weight, a=_LEAKY_SLOPE)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        n_units = sum(self.config.units) + sum(self.config.units[:-1])
        for module in self.modules():
            if isinstance(module, ResidualUnit):
                # Without normalisation each unit would double the variance; n of them together add about 1.
                with torch.no_grad():
                    module.conv[-1].conv.weight.mul_(1.0 / math.sqrt(n_units))  # type: ignore[union-attr, operator]
            elif isinstance(module, SubpixelUpsample):
                _tie_subpixels(module.conv_block, factor=8)
        nn.init.zeros_(self.head.weight)  # its bias is zero already

    def forward(self, given: PriorInputs) -> tuple[Tensor, Tensor]:
        """Return the ungated residual F in (-1, 1), and the logit of a voxel being brain.

        Any size works, because volumes are padded with zeros at the far end.

        Args:
            given: the volumes; those that the configuration does not use are ignored.

        Returns:
            Two of [B, 1, I, J, K].

        Raises:
            ValueError: a volume that the network needs is missing.
        """
        inputs = torch.cat(given.shown(self.config), 1)
        size = inputs.shape[2:]
        far_end = [padding for extent in reversed(size) for padding in (0, -extent % self.config.stride)]
        inputs = functional.pad(inputs, far_end)

        features = self.stem(_channels_last(pixelunshuffle(inputs, 3, 2)))
        skips = []
        for encode, down in zip(self.encoder[:-1], self.down, strict=True):
            features = encode(features)
            skips.append(features)
            features = down(features)
        features = self.encoder[-1](features)
        for up, decode in zip(reversed(self.up), reversed(self.decoder), strict=True):
            features = decode(_channels_last(up(features)) + skips.pop())
        out = self._in_slabs(features, inputs)[:, :, : size[0], : size[1], : size[2]]
        return torch.tanh(out[:, :1]), out[:, 1:]

    def _at_full_resolution(self, features: Tensor, inputs: Tensor) -> Tensor:
        """The last layers: features at half resolution and the inputs to F."""
        features = torch.cat([self.to_full(features), inputs], 1)
        return self.head(self.tail(_channels_last(features)))

    def _in_slabs(self, features: Tensor, inputs: Tensor) -> Tensor:
        """`_at_full_resolution`, slab by slab if no gradient is needed.

        These layers hold most of the memory. A slab includes the two voxels beyond it that its layers reach, so that
        the result equals that of the whole volume, up to rounding.
        """
        n_rows = features.shape[2]
        if torch.is_grad_enabled() or n_rows <= SLAB_ROWS + 2:
            return self._at_full_resolution(features, inputs)
        out = torch.empty_like(inputs[:, :2])
        for begin in range(0, n_rows, SLAB_ROWS):
            # all slabs have one shape, the last one overlapping, because kernels are set up and kept for each shape
            low = min(max(begin - 1, 0), n_rows - SLAB_ROWS - 2)
            high = low + SLAB_ROWS + 2
            seen = self._at_full_resolution(features[:, :, low:high], inputs[:, :, 2 * low : 2 * high])
            end = min(begin + SLAB_ROWS, n_rows)
            out[:, :, 2 * begin : 2 * end] = seen[:, :, 2 * (begin - low) : 2 * (end - low)]
        return out


def _residual_units(width: int, count: int) -> nn.Sequential:
    """Return `count` residual units with a linear shortcut and no activation after the sum."""
    units = [ResidualUnit(3, width, width, last_conv_only=True, **_BLOCK) for _ in range(count)]
    return nn.Sequential(*units)


def _subpixel_upsample(in_channels: int, out_channels: int) -> SubpixelUpsample:
    """Return a doubling of the resolution: 1x1x1 convolution to 8 times the channels, then rearrangement.

    The convolutions before and after see the neighbourhood; a 3x3x3 kernel here would hold
    half of all the weights. No averaging afterwards (MONAI's `apply_pad_pool`): it shifts by half a voxel.
    """
    to_subpixels = nn.Conv3d(in_channels, 8 * out_channels, kernel_size=1)
    return SubpixelUpsample(3, in_channels, out_channels, scale_factor=2, conv_block=to_subpixels, apply_pad_pool=False)


def _tie_subpixels(conv: nn.Conv3d, factor: int) -> None:
    """Give the `factor` sub-pixels of each output channel equal weights (no checkerboard at the start)."""
    with torch.no_grad():
        conv.weight.copy_(conv.weight[::factor].repeat_interleave(factor, dim=0))


def _channels_last(features: Tensor) -> Tensor:
    """Return the same values with channels innermost, where CPU convolutions are up to twice as fast."""
    return features.contiguous(memory_format=torch.channels_last_3d)
