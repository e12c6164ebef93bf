"""The one file that carries a trained prior: weights, arguments and the conventions they hold under."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from g3r._version import __version__
from g3r.acquisition.coarse_volume import DENSITY_CONVENTION, INTENSITY_CONVENTION
from g3r.acquisition.least_squares import SHARP_CONVENTION
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

if TYPE_CHECKING:
    from g3r.prior.dgpn import DensityGatedPriorNetwork

KIND = "prior"
FORMAT_VERSION = 1
VOXEL_MM_RANGE = (0.1, 10.0)
VOXEL_MM_TOLERANCE = 1e-3

MAX_ARGUMENTS = {"channels": 4096, "units": 64, "tail_channels": 4096}
"""Beyond these a network takes minutes to build, and is none of ours."""

_ANOTHER_FILE = "pass a file made by g3r-export, or leave --ckpt out to use the weights that ship with g3r"


@dataclass(frozen=True)
class PriorCheckpoint:
    """What a prior file says about its weights.

    Attributes:
        network_arguments: constructor arguments of `DensityGatedPriorNetwork` (alpha and beta among them).
        voxel_mm: isotropic voxel size the prior was trained at.
        training_data: what it was trained on, in words.
        validation: named scores, for example {"val/psnr_prior": 31.2} (dB).
        density_convention: see `DENSITY_CONVENTION`.
        intensity_convention: see `INTENSITY_CONVENTION`.
        sharp_convention: see `SHARP_CONVENTION`.
        g3r_version: version of g3r that wrote the file.
    """

    network_arguments: Mapping[str, Any]
    voxel_mm: float
    training_data: str
    validation: Mapping[str, float] = field(default_factory=dict)
    density_convention: str = DENSITY_CONVENTION
    intensity_convention: str = INTENSITY_CONVENTION
    sharp_convention: str = SHARP_CONVENTION
    g3r_version: str = __version__

    def __post_init__(self) -> None:
        low, high = VOXEL_MM_RANGE
        if not (math.isfinite(self.voxel_mm) and low <= self.voxel_mm <= high):
            raise ValueError(f"voxel size is {self.voxel_mm} mm; expected {low} to {high} mm")

    @property
    def alpha(self) -> float:
        """Gate at high density."""
        return float(self.network_arguments["alpha"])

    @property
    def beta(self) -> float:
        """Gate at zero density."""
        return float(self.network_arguments["beta"])


def save_prior_checkpoint(path: str | Path, network: "DensityGatedPriorNetwork", meta: PriorCheckpoint) -> None:
    """Write weights and description to one file, whole or not at all.

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
    path = Path(path)
    weights = plain_weights(network)
    content = {
        "format": f"g3r-{KIND}",
        "format_version": FORMAT_VERSION,
        "g3r_version": meta.g3r_version,
        "network_arguments": dict(meta.network_arguments),
        "alpha": meta.alpha,
        "beta": meta.beta,
        "density_convention": meta.density_convention,
        "intensity_convention": meta.intensity_convention,
        "sharp_convention": meta.sharp_convention,
        "voxel_mm": float(meta.voxel_mm),
        "training_data": str(meta.training_data),
        "validation": {str(name): float(value) for name, value in meta.validation.items()},
        "weights_sha256": weights_digest(weights),
        "weights": weights,
    }
    write_file(path, content)


def load_prior(path: str | Path, voxel_mm: float | None = None) -> "tuple[DensityGatedPriorNetwork, PriorCheckpoint]":
    """Read a prior file.

    Nothing in the file is executed (`weights_only=True`), and everything it claims is checked.

    Args:
        path: file written by `save_prior_checkpoint`.
        voxel_mm: voxel size that it will be used at; None takes any.

    Returns:
        The network on the CPU in evaluation mode, float32, and its description.

    Raises:
        InputError: missing, not a prior, damaged, of another format version, convention or voxel size, with
            weights that do not fit the network, or with values that make no sense.
    """
    path = Path(path)
    content = read_file(path, KIND, _ANOTHER_FILE)
    conventions = {
        "format_version": FORMAT_VERSION,
        "density_convention": DENSITY_CONVENTION,
        "intensity_convention": INTENSITY_CONVENTION,
        "sharp_convention": SHARP_CONVENTION,
    }
    check_identity(path, content, KIND, conventions, _ANOTHER_FILE)
    meta = _describe(path, content)
    if voxel_mm is not None and not abs(meta.voxel_mm - voxel_mm) <= VOXEL_MM_TOLERANCE:
        raise InputError(
            f"{path}: was trained on voxels of {meta.voxel_mm:g} mm, expected {voxel_mm:g} mm; pass another "
            f"file, or --prior-voxel {meta.voxel_mm:g} if that is what you want"
        )
    from g3r.prior.dgpn import DensityGatedPriorNetwork  # MONAI: only once the file has proved good

    arguments = meta.network_arguments
    network = built(path, lambda: DensityGatedPriorNetwork(**arguments), lambda: _min_values(arguments), content, KIND)
    check_digest(path, network.state_dict(), content.get("weights_sha256"))
    # Only the speed changes: convolutions on a CPU are up to twice as fast with channels innermost.
    return network.to(memory_format=torch.channels_last_3d).eval(), meta  # type: ignore[call-overload]


def _min_values(arguments: Mapping[str, Any]) -> float:
    """A lower bound on the number of a network's weights: of its residual units and its tail."""
    levels = zip(arguments["channels"], arguments["units"], strict=True)
    return 27 * (sum(2 * n * width**2 for width, n in levels) + arguments["tail_channels"] ** 2)


def _describe(path: Path, content: Mapping[str, Any]) -> PriorCheckpoint:
    """Return the description with its values checked."""
    try:
        meta = PriorCheckpoint(
            network_arguments=plain_arguments(content, MAX_ARGUMENTS),
            voxel_mm=number(content, "voxel_mm"),
            training_data=text(content, "training_data"),
            validation=scores(content),
            density_convention=content["density_convention"],
            intensity_convention=content["intensity_convention"],
            sharp_convention=content["sharp_convention"],
            g3r_version=text(content, "g3r_version"),
        )
        agrees = (meta.alpha, meta.beta) == (number(content, "alpha"), number(content, "beta"))
    except KeyError as error:
        raise InputError(f"{path}: is damaged (entry {error} is missing); copy or export it again") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {one_line(error)}; copy or export it again") from error
    if not agrees or not isinstance(content.get("weights"), dict):
        raise InputError(f"{path}: is damaged (its entries contradict each other); copy or export it again")
    return meta
