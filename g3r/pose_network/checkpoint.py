"""The one file that carries a trained pose network: weights, mean heads, and what they hold for."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from g3r._version import __version__
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.checkpoints.file import (
    built,
    check_digest,
    check_identity,
    number,
    one_line,
    plain_arguments,
    plain_weights,
    read_file,
    scores,
    text,
    weights_digest,
    write_file,
)
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

if TYPE_CHECKING:
    from g3r.pose_network.network import PoseNetwork

KIND = "pose"
FORMAT_VERSION = 1
TEMPLATE_KEY = "template"
"""The network's buffer of mean heads."""

MAX_ARGUMENTS = {
    "template_shape": 1024,
    "template_spacing_mm": 100,
    "image_size": 1024,
    "pixel_mm": 100,
    "channels": 4096,
    "width": 8192,
    "n_blocks": 64,
    "n_heads": 64,
    "n_refinements": 16,
}
"""Beyond these a network takes minutes to build, and is none of ours."""

_ANOTHER_FILE = "pass a pose network made by g3r-export, or leave it out to use the weights that ship with g3r"


@dataclass(frozen=True)
class PoseCheckpoint:
    """What a pose file says about its weights.

    Attributes:
        network_arguments: constructor arguments of `PoseNetwork`.
        template: mean heads of the subjects that it was trained on; the poses are in its frame.
        training_data: what it was trained on, in words.
        validation: named scores, for example {"val/slice_mm": 4.0}.
        g3r_version: version of g3r that wrote the file.
    """

    network_arguments: Mapping[str, Any]
    template: AtlasTemplate
    training_data: str
    validation: Mapping[str, float] = field(default_factory=dict)
    g3r_version: str = __version__

    def __post_init__(self) -> None:
        arguments = self.network_arguments
        expected = centred_grid(arguments["template_shape"], float(arguments["template_spacing_mm"]))
        found = self.template.volume.shape
        if tuple(arguments["template_shape"]) != found or not np.allclose(
            self.template.affine, expected.affine, atol=1e-3
        ):
            raise ValueError(
                f"template {found} is not the network's: {arguments['template_shape']} about the origin at "
                f"{arguments['template_spacing_mm']} mm"
            )

    @property
    def pixel_mm(self) -> float:
        """Edge of the pixels that the network looks at."""
        return float(self.network_arguments["pixel_mm"])

    @property
    def image_size(self) -> int:
        """Pixels per edge of the images that it looks at."""
        return int(self.network_arguments["image_size"])


def centred_grid(template_shape: Any, spacing_mm: float) -> VolumeGrid:
    """The grid about the origin of a template [A, I, J, K]."""
    shape = np.array(template_shape[1:])
    return VolumeGrid.isotropic(-(shape - 1) / 2 * spacing_mm, (shape - 1) / 2 * spacing_mm, spacing_mm)


def save_pose_checkpoint(path: str | Path, network: "PoseNetwork", meta: PoseCheckpoint) -> None:
    """Write weights, template and description to one file, whole or not at all.

    Weights and template are rounded to float16, which changes poses by less than 0.1 mm.

    Args:
        path: file to write; an existing one is replaced.
        network: the trained network.
        meta: its description; `meta.network_arguments` must be `network.arguments()`.

    Raises:
        ValueError: `meta` describes another network.
        InputError: the file cannot be written.
    """
    if dict(meta.network_arguments) != network.arguments():
        raise ValueError(f"meta describes {dict(meta.network_arguments)}, the network is {network.arguments()}")
    weights = {name: _rounded(name, value) for name, value in plain_weights(network).items()}
    template = torch.from_numpy(meta.template.volume).half()
    weights[TEMPLATE_KEY] = template.permute(1, 2, 3, 0).contiguous()
    content = {
        "format": f"g3r-{KIND}",
        "format_version": FORMAT_VERSION,
        "g3r_version": meta.g3r_version,
        "network_arguments": dict(meta.network_arguments),
        "weeks": [float(week) for week in meta.template.weeks],
        "training_data": str(meta.training_data),
        "validation": {str(name): float(value) for name, value in meta.validation.items()},
        "weights_sha256": weights_digest(weights),
        "weights": weights,
    }
    write_file(Path(path), content)


def load_pose_network(path: str | Path) -> "tuple[PoseNetwork, PoseCheckpoint]":
    """Read a pose file.

    Nothing in the file is executed (`weights_only=True`), and everything it claims is checked.

    Args:
        path: file written by `save_pose_checkpoint`.

    Returns:
        The network on the CPU in evaluation mode, float32, and its description with the template.

    Raises:
        InputError: missing, not a pose network, damaged, of another format version, with weights that do not
            fit the network, or with values that make no sense.
    """
    path = Path(path)
    content = read_file(path, KIND, _ANOTHER_FILE)
    check_identity(path, content, KIND, {"format_version": FORMAT_VERSION}, _ANOTHER_FILE)
    if not isinstance(content.get("weights"), dict):
        raise InputError(f"{path}: is damaged (holds no weights); copy or export it again")

    from g3r.pose_network.network import PoseNetwork  # MONAI: only once the file has proved good

    try:
        arguments = plain_arguments(content, MAX_ARGUMENTS)
    except KeyError as error:
        raise InputError(f"{path}: is damaged (entry {error} is missing); copy or export it again") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {one_line(error)}; copy or export it again") from error
    network = built(path, lambda: PoseNetwork(**arguments), lambda: _min_values(arguments), content, KIND)
    check_digest(path, network.state_dict(), content.get("weights_sha256"))
    return network.eval(), _describe(path, content, network)


def _describe(path: Path, content: Mapping[str, Any], network: "PoseNetwork") -> PoseCheckpoint:
    """Return the description with its values checked."""
    arguments = network.arguments()
    try:
        grid = centred_grid(arguments["template_shape"], arguments["template_spacing_mm"])
        template = AtlasTemplate(
            network.template.permute(3, 0, 1, 2).numpy(), grid.affine, np.array(_weeks(content), float)
        )
        return PoseCheckpoint(
            network_arguments=arguments,
            template=template,
            training_data=text(content, "training_data"),
            validation=scores(content),
            g3r_version=text(content, "g3r_version"),
        )
    except KeyError as error:
        raise InputError(f"{path}: is damaged (entry {error} is missing); copy or export it again") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {one_line(error)}; copy or export it again") from error


def _min_values(arguments: Mapping[str, Any]) -> float:
    """A lower bound on the number of a network's weights: of its template, token layers, units and blocks."""
    third, width = arguments["channels"][-1], arguments["width"]
    token = third * (arguments["image_size"] // 8) ** 2 * width
    units = 9 * sum(one**2 for one in arguments["channels"][1:])
    return math.prod(arguments["template_shape"]) + 2 * (token + units + 4 * arguments["n_blocks"] * width**2)


def _weeks(content: Mapping[str, Any]) -> list[float]:
    """Gestational ages of the mean heads; `KeyError` without them, `TypeError` for something else."""
    weeks = content["weeks"]
    if not isinstance(weeks, list | tuple):
        raise TypeError("weeks is no list of ages")
    return [number({"weeks": week}, "weeks") for week in weeks]


def _rounded(name: str, value: Tensor) -> Tensor:
    """Half the bytes of a floating-point array. Counters of training batches have no use any more: zero."""
    return torch.zeros((), dtype=torch.int64) if name.endswith("num_batches_tracked") else value.half()
