"""The two parts of each step of the pose network: encoder of slice images, transformer from tokens to votes."""

from collections.abc import Sequence

import torch
from monai.networks.blocks import Convolution, ResidualUnit, TransformerBlock
from torch import Tensor, nn

from g3r.checkpoints.device import is_bfloat16_fast


class Encoder(nn.Module):
    """Slice image to token: MONAI's residual units, and a linear layer that keeps positions in the image.

    Args:
        channels: feature channels after each of three halvings of the image.
        width: width of the token.
        image_size: pixels per edge, a multiple of 8.
        extra_channels: further channels at half the image's resolution.
    """

    def __init__(self, channels: Sequence[int], width: int, image_size: int, extra_channels: int = 0) -> None:
        super().__init__()
        first, second, third = channels
        self.stem = Convolution(2, 1, first, strides=2, kernel_size=3, act="relu", norm="batch")
        self.extra = (
            Convolution(2, extra_channels, first, kernel_size=3, act="relu", norm="batch") if extra_channels else None
        )
        into = first * (2 if extra_channels else 1)
        self.body = nn.Sequential(
            ResidualUnit(2, into, second, strides=2, subunits=2, act="relu", norm="batch"),
            ResidualUnit(2, second, third, strides=2, subunits=2, act="relu", norm="batch"),
        )
        self.token = nn.Linear(third * (image_size // 8) ** 2, width)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: Tensor, extra: Tensor | None = None) -> Tensor:
        """Return tokens [S, width] of images [S, 1, N, N] and, with `extra_channels`, [S, E, N / 2, N / 2]."""
        # bfloat16 halves the time of a training step; the poses are always computed in float32
        short = self.training and is_bfloat16_fast(image.device.type)
        with torch.autocast(image.device.type, torch.bfloat16, enabled=short):
            # a convolution on a CPU is faster with channels innermost
            features = self.stem(image.to(memory_format=torch.channels_last))
            if self.extra is not None and extra is not None:
                features = torch.cat([features, self.extra(extra)], 1)
            token = self.token(self.body(features).flatten(1))
        return token.float()


class SetTransformer(nn.Module):
    """Tokens of slices to votes: attention in turn among the slices of a stack and among those of a head.

    Args:
        width: width of a token.
        n_codes: numbers that describe a slice in addition to its image.
        n_blocks: transformer blocks; the even ones see one stack, the odd ones all stacks of the head.
        n_heads: attention heads.
    """

    def __init__(self, width: int, n_codes: int, n_blocks: int, n_heads: int) -> None:
        super().__init__()
        self.code = nn.Sequential(nn.Linear(n_codes, width), nn.ReLU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(
            TransformerBlock(width, 2 * width, n_heads, use_flash_attention=True) for _ in range(n_blocks)
        )
        self.norm = nn.LayerNorm(width)
        self.vote = nn.Linear(width, 18)
        nn.init.normal_(self.vote.weight, std=0.01)
        nn.init.zeros_(self.vote.bias)

    def forward(self, token: Tensor, code: Tensor, same_stack: Tensor, same_set: Tensor) -> Tensor:
        """Return a vote per slice.

        Args:
            token: [S, width] of the slices' images.
            code: [S, n_codes] further facts about the slices.
            same_stack: [S, S] whether two slices are of one stack.
            same_set: [S, S] whether two slices are of one head.

        Returns:
            [S, 18]: rotation (9) and translation (3) of the stack, the slice's own rotation (3) and translation (3).
        """
        x = (token + self.code(code))[None]
        for number, block in enumerate(self.blocks):
            x = block(x, attn_mask=(same_set if number % 2 else same_stack)[None, None])
        return self.vote(self.norm(x[0]))
