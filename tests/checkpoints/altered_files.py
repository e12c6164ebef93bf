"""Small exported networks, and files with altered descriptions, tensors or bytes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from g3r.checkpoints.weights_file import DESCRIPTION_KEY
from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.model import PoseModel
from g3r.pose_network.network import PoseNetwork
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.model import Prior

Content = dict[str, Any]
"""Content of a file: its description, with the tensors by name under "weights"."""


def small_prior() -> Prior:
    """A prior of a few hundred weights."""
    torch.manual_seed(0)
    config = PriorNetworkConfig(channels=(4, 4), units=(1, 1), tail_channels=2, alpha=0.1, beta=0.9, use_sharp=False)
    network = DensityGatedPriorNetwork(config).eval()
    torch.nn.init.normal_(network.refiner.head.weight)
    network.set_template(torch.rand(2, 4, 5, 3))
    return Prior(
        network=network, voxel_mm=0.8, weeks=(25.0, 31.0), training_data="two phantoms", validation={"val/psnr": 30.0}
    )


def small_pose() -> PoseModel:
    """The smallest possible pose network."""
    torch.manual_seed(0)
    config = PoseNetworkConfig(
        template_shape=(2, 5, 6, 4),
        template_spacing_mm=6.0,
        image_size=8,
        channels=(2, 2, 2),
        width=8,
        n_blocks=1,
        n_heads=2,
    )
    network = PoseNetwork(config).eval()
    network.set_template(torch.rand(2, 5, 6, 4).half().float())
    return PoseModel(network=network, weeks=(25.0, 31.0), training_data="two phantoms", validation={"val/mm": 4.5})


def content_of(path: Path) -> Content:
    """Description and tensors of a good file."""
    whole = path.read_bytes()
    header = json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")])
    return json.loads(header["__metadata__"][DESCRIPTION_KEY]) | {"weights": load(whole)}


def write_content(path: Path, content: Content) -> None:
    """Write a changed result of `content_of` without any check."""
    weights: dict[str, Tensor] = content["weights"]
    description = {name: value for name, value in content.items() if name != "weights"}
    path.write_bytes(save(weights, {DESCRIPTION_KEY: json.dumps(description)}))


def change_header(whole: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """The bytes of a file with a changed header before the same tensors."""
    n_header = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + n_header])
    change(header)
    return with_header(json.dumps(header).encode(), whole[8 + n_header :])


def with_header(header: bytes, tensors: bytes = b"") -> bytes:
    """The bytes of a file with the given header, valid or not."""
    return len(header).to_bytes(8, "little") + header + tensors
