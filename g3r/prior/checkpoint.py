"""The one file that carries a trained prior: weights, arguments and the conventions they hold under."""

import hashlib
import math
import os
import pickle
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from g3r._version import __version__
from g3r.acquisition.scatter import DENSITY_CONVENTION, INTENSITY_CONVENTION
from g3r.errors import InputError

if TYPE_CHECKING:
    from g3r.prior.dgpn import DensityGatedPriorNetwork

FORMAT = "g3r-prior"
FORMAT_VERSION = 1
VOXEL_MM_RANGE = (0.1, 10.0)

_ANOTHER_FILE = "pass a file made by g3r-export, or leave --ckpt out to use the weights that ship with g3r"
_AGAIN = "train and export a prior with this version of g3r"


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
        g3r_version: version of g3r that wrote the file.
    """

    network_arguments: Mapping[str, Any]
    voxel_mm: float
    training_data: str
    validation: Mapping[str, float] = field(default_factory=dict)
    density_convention: str = DENSITY_CONVENTION
    intensity_convention: str = INTENSITY_CONVENTION
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


def save_prior_checkpoint(
    path: str | Path, network: "DensityGatedPriorNetwork", meta: PriorCheckpoint
) -> None:
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
        raise ValueError(
            f"meta describes {dict(meta.network_arguments)}, the network is {network.arguments()}"
        )
    path = Path(path)
    # Channels-last is a matter of the machine: the file holds plain row-major float32.
    weights = {
        name: value.detach().to("cpu", torch.float32).clone(memory_format=torch.contiguous_format)
        for name, value in network.state_dict().items()
    }
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "g3r_version": meta.g3r_version,
        "network_arguments": dict(meta.network_arguments),
        "alpha": meta.alpha,
        "beta": meta.beta,
        "density_convention": meta.density_convention,
        "intensity_convention": meta.intensity_convention,
        "voxel_mm": float(meta.voxel_mm),
        "training_data": str(meta.training_data),
        "validation": {str(name): float(value) for name, value in meta.validation.items()},
        "weights_sha256": _digest(weights),
        "weights": weights,
    }
    beside = None
    try:
        descriptor, beside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(descriptor, "wb") as stream:
            torch.save(content, stream)
        Path(beside).chmod(0o644)  # mkstemp makes files that only their owner reads
        Path(beside).replace(path)
    except OSError as error:
        if beside is not None:
            Path(beside).unlink(missing_ok=True)
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); choose a writable path"
        ) from error


def load_prior(path: str | Path) -> "tuple[DensityGatedPriorNetwork, PriorCheckpoint]":
    """Read a prior file.

    Nothing in the file is executed (`weights_only=True`), and everything it claims is checked.

    Args:
        path: file written by `save_prior_checkpoint`.

    Returns:
        The network on the CPU in evaluation mode, float32, and its description.

    Raises:
        InputError: missing, not a prior, damaged, of another format version or convention, with weights
            that do not fit the network, or with values that make no sense.
    """
    path = Path(path)
    content = _read(path)
    _check_identity(path, content)
    meta = _describe(path, content)
    network = _build(path, meta, content["weights"])
    if _digest(network.state_dict()) != content.get("weights_sha256"):
        raise InputError(
            f"{path}: is damaged (the weights do not match their checksum); copy or export it again"
        )
    # Only the speed changes: convolutions on a CPU are up to twice as fast with channels innermost.
    return network.to(memory_format=torch.channels_last_3d).eval(), meta  # type: ignore[call-overload]


def _read(path: Path) -> dict[str, Any]:
    """Return the file's dict, or say in one line why there is none."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; expected a prior checkpoint; {_ANOTHER_FILE}") from error
    except (IsADirectoryError, PermissionError) as error:
        raise InputError(f"{path}: cannot be read ({_one_line(error)}); {_ANOTHER_FILE}") from error
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, OSError) as error:
        # torch.load says "damaged" in many types; what the file begins with tells which advice helps.
        with path.open("rb") as stream:
            is_zip = stream.read(2) == b"PK"
        if is_zip:
            found = "is damaged or not written by g3r-export"
        else:
            found = "is not a prior checkpoint (not a file of torch.save)"
        raise InputError(f"{path}: {found}; {_ANOTHER_FILE}") from error
    if not isinstance(content, dict):
        raise InputError(
            f"{path}: is not a prior checkpoint (holds a {type(content).__name__}); {_ANOTHER_FILE}"
        )
    return content


def _check_identity(path: Path, content: Mapping[str, Any]) -> None:
    """Refuse another kind of file, another version of the format, and other conventions."""
    if content.get("format") != FORMAT:
        if "pytorch-lightning_version" in content:
            raise InputError(
                f"{path}: is a Lightning training checkpoint; turn it into a prior with g3r-export"
            )
        found = f"format is {content.get('format')!r}, expected {FORMAT!r}"
        raise InputError(f"{path}: is not a prior checkpoint ({found}); {_ANOTHER_FILE}")
    for key, expected in (
        ("format_version", FORMAT_VERSION),
        ("density_convention", DENSITY_CONVENTION),
        ("intensity_convention", INTENSITY_CONVENTION),
    ):
        if content.get(key) != expected:
            name = key.replace("_", " ")
            raise InputError(f"{path}: {name} is {content.get(key)!r}, this g3r reads {expected!r}; {_AGAIN}")


def _describe(path: Path, content: Mapping[str, Any]) -> PriorCheckpoint:
    """Return the description with its values checked."""
    try:
        arguments = content["network_arguments"]
        meta = PriorCheckpoint(
            network_arguments=dict(arguments),
            voxel_mm=float(content["voxel_mm"]),
            training_data=str(content["training_data"]),
            validation={str(name): float(value) for name, value in content["validation"].items()},
            density_convention=content["density_convention"],
            intensity_convention=content["intensity_convention"],
            g3r_version=str(content["g3r_version"]),
        )
        agrees = (meta.alpha, meta.beta) == (content["alpha"], content["beta"])
    except KeyError as error:
        raise InputError(f"{path}: is damaged (entry {error} is missing); copy or export it again") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {_one_line(error)}; copy or export it again") from error
    if not agrees or not isinstance(content.get("weights"), dict):
        raise InputError(f"{path}: is damaged (its entries contradict each other); copy or export it again")
    return meta


def _build(path: Path, meta: PriorCheckpoint, weights: Mapping[str, Any]) -> "DensityGatedPriorNetwork":
    """Return the network with the weights in it."""
    from g3r.prior.dgpn import DensityGatedPriorNetwork  # MONAI: only once the file has proved good

    try:
        network = DensityGatedPriorNetwork(**meta.network_arguments)
        network.load_state_dict(dict(weights), strict=True)
    except (TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise InputError(
            f"{path}: weights and network arguments do not fit together ({_one_line(error)}); {_AGAIN}"
        ) from error
    for name, value in network.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{path}: weight {name} holds NaN or infinity; export another checkpoint")
    return network


def _digest(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, shapes and float32 values, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        value = weights[name].detach().to("cpu", torch.float32)
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.contiguous(memory_format=torch.contiguous_format).numpy().tobytes())
    return digest.hexdigest()


def _one_line(error: BaseException) -> str:
    """Return the first 120 characters of an error's text without line breaks."""
    return " ".join(str(error).split())[:120]
