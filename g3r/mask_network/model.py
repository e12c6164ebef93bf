"""A trained mask network and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from g3r.checkpoints.trained_model import TrainedModel
from g3r.mask_network.config import MaskNetworkConfig
from g3r.mask_network.network import MaskNetwork


@dataclass(frozen=True, kw_only=True)
class MaskModel(TrainedModel):
    """A trained mask network. See `TrainedModel` for `load`, `save` and `record`.

    Its weights are stored as float16, which changes hardly a pixel.
    """

    network: MaskNetwork

    kind: ClassVar = "mask"
    config_type: ClassVar = MaskNetworkConfig
    network_type: ClassVar = MaskNetwork

    @classmethod
    def own_facts(cls, description: Mapping[str, Any]) -> dict[str, Any]:
        """No facts apart from the weights."""
        return {}

    def own_description(self) -> dict[str, Any]:
        """No facts apart from the weights."""
        return {}

    def in_words(self) -> str:
        """Both pixel sizes, in words."""
        config = self.network.config
        return f"brain masks, found at {config.wide_mm:g} mm, outlined at {config.pixel_mm:g} mm"

    @staticmethod
    def stored(name: str, value: Tensor) -> Tensor:
        """As float16, half the bytes."""
        return value.half()
