"""A trained pose network: the network, its atlas template, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.acquisition.slice_images import slice_images
from g3r.checkpoints.plain_values import numbers
from g3r.checkpoints.trained_model import TrainedModel
from g3r.geometry import RigidPose
from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.inference import poses_of, slice_batch
from g3r.pose_network.network import PoseNetwork


@dataclass(frozen=True, kw_only=True)
class PoseModel(TrainedModel):
    """A trained pose network with the ages of its template. See `TrainedModel` for `load`, `save` and `record`.

    Its weights are stored as float16, which changes poses by less than 0.1 mm.

    Attributes:
        weeks: gestational age of each head of the network's template.

    Raises:
        ValueError: the number of ages differs from the template's.
    """

    network: PoseNetwork
    weeks: tuple[float, ...]

    kind: ClassVar = "pose"
    config_type: ClassVar = PoseNetworkConfig
    network_type: ClassVar = PoseNetwork

    def __post_init__(self) -> None:
        if len(self.weeks) != self.network.config.template_shape[0]:
            raise ValueError(f"{len(self.weeks)} ages for a template of {self.network.config.template_shape[0]}")

    @classmethod
    def own_facts(cls, description: Mapping[str, Any]) -> dict[str, Any]:
        """The template's ages."""
        return {"weeks": numbers(description, "weeks")}

    def own_description(self) -> dict[str, Any]:
        """The template's ages."""
        return {"weeks": [float(week) for week in self.weeks]}

    def in_words(self) -> str:
        """Pixel size and ages, in words."""
        weeks = ", ".join(f"{week:g}" for week in self.weeks)
        return f"poses from pixels of {self.network.config.pixel_mm:g} mm, atlas template of {weeks} weeks"

    @staticmethod
    def stored(name: str, value: Tensor) -> Tensor:
        """As float16, half the bytes; counters of training batches are not needed any more and become zero."""
        return torch.zeros((), dtype=torch.int64) if name.endswith("num_batches_tracked") else value.half()

    @cached_property
    def template(self) -> AtlasTemplate:
        """The network's atlas template; the predicted poses are in its frame."""
        volume = self.network.template.permute(3, 0, 1, 2).cpu().numpy()
        return AtlasTemplate(volume, self.network.config.template_grid.affine, np.array(self.weeks))

    def predict(self, slices: Slices) -> RigidPose:
        """Pose of each slice's own frame (as `slices.planes.pose`) in the atlas frame.

        Args:
            slices: slices of all stacks; of their poses only those of the headers are used.

        Returns:
            K poses. They do not change if all headers are moved by one rigid motion, and permuting slices or
            stacks permutes them.
        """
        config = self.network.config
        images = slice_images(slices, config.pixel_mm, config.image_size)
        device = self.network.template.device
        batch = {name: value.to(device) for name, value in slice_batch([images]).items()}
        return poses_of(self.network, batch) @ images.frame_in_slice.inverse()
