"""A trained network with the facts in its file: the common base of prior, pose and mask networks."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from g3r._version import __version__
from g3r.checkpoints.plain_values import config_from_plain, named_numbers, shown, text
from g3r.checkpoints.shipped import weights_path
from g3r.checkpoints.weights_file import WeightsFile, another_file, read_weights, write_weights
from g3r.errors import G3RError, InputError, one_line
from g3r.run.on_demand import torch

if TYPE_CHECKING:
    from torch import Tensor, nn

FORMAT_VERSION = 2

DAMAGED = "copy or export it again"


class NetworkConfig(Protocol):
    """A frozen dataclass with the arguments of a network; it raises `ValueError` for values out of range."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def min_values(self) -> float:
        """A lower bound on the number of the network's weights."""


@dataclass(frozen=True, kw_only=True)
class TrainedModel:
    """A trained network and the facts in its file.

    A subclass is one kind of file. It defines the kind, the class of the network, and further facts needed to use it.

    Attributes:
        network: the network, on the CPU and in evaluation mode; its `config` holds its arguments.
        training_data: its training data, in words.
        validation: named scores, for example {"val/psnr_prior": 31.2}.
        g3r_version: version of g3r that exported it.
        file_name: name of the file that it was read from, without its folder; empty if there is none.
        file_sha256: SHA-256 of that file's bytes.
    """

    network: Any
    training_data: str
    validation: Mapping[str, float] = field(default_factory=dict)
    g3r_version: str = __version__
    file_name: str = ""
    file_sha256: str = ""

    kind: ClassVar[str]
    config_type: ClassVar[type]
    network_type: ClassVar[type[nn.Module]]
    conventions: ClassVar[Mapping[str, str]] = {}
    """Entries of the description that must hold these values."""

    @classmethod
    def own_facts(cls, description: Mapping[str, Any]) -> dict[str, Any]:
        """The subclass's own attributes, from a description; raises as `number` and `text` do."""
        raise NotImplementedError

    def own_description(self) -> dict[str, Any]:
        """The subclass's own attributes, in plain values."""
        raise NotImplementedError

    def in_words(self) -> str:
        """Short description of the model."""
        raise NotImplementedError

    @staticmethod
    def stored(name: str, value: Tensor) -> Tensor:
        """The form in which a float32 tensor of the network is written."""
        return value

    @cached_property
    def weights_sha256(self) -> str:
        """SHA-256 of the weights' names, shapes and float32 values."""
        return weights_digest(self.network.state_dict())

    def record(self) -> dict[str, Any]:
        """All facts in plain values, for the file's header and for run.json."""
        return {
            "g3r_version": self.g3r_version,
            "network_arguments": asdict(self.network.config),
            **self.conventions,
            **self.own_description(),
            "training_data": self.training_data,
            "validation": dict(self.validation),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights and description to one file, whole or not at all; an existing one is replaced.

        Raises:
            InputError: the file cannot be written.
        """
        # row-major float32 on the CPU, because memory formats depend on the machine
        tensors = {
            name: self.stored(
                name, value.detach().to("cpu", torch.float32).clone(memory_format=torch.contiguous_format)
            )
            for name, value in self.network.state_dict().items()
        }
        identity = {"format": f"g3r-{self.kind}", "format_version": FORMAT_VERSION}
        description = {**identity, **self.record(), "weights_sha256": weights_digest(tensors)}
        write_weights(Path(path), description, tensors)

    @classmethod
    def load(cls, source: str | os.PathLike[str] | WeightsFile | None = None) -> Self:
        """Read an exported file. Nothing in it is executed, and all its entries are checked.

        Args:
            source: path of a file written by `save`, or that file as `read_weights` gives it; the name of a set of
                weights that ships with the package (`SET_NAMES`), or None for the usual one.

        Raises:
            InputError: the file is missing, damaged or of another kind, format version or convention, its weights do
                not fit the network, or values make no sense.
        """
        file = source if isinstance(source, WeightsFile) else read_weights(weights_path(source, cls.kind), cls.kind)
        description = file.description
        _check_identity(file, cls.kind, {"format_version": FORMAT_VERSION, **cls.conventions})
        try:
            config: NetworkConfig = config_from_plain(cls.config_type, description["network_arguments"])
            facts: dict[str, Any] = {
                "training_data": text(description, "training_data"),
                "validation": named_numbers(description, "validation"),
                "g3r_version": text(description, "g3r_version"),
                **cls.own_facts(description),
            }
            network = _filled(cls.network_type, config, file)
            model = cls(network=network, file_name=file.path.name, file_sha256=file.sha256, **facts)
        except KeyError as error:
            raise InputError(f"{file.path}: is damaged (entry {error} is missing); {DAMAGED}") from error
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{file.path}: {one_line(error)}; {DAMAGED}") from error
        if model.weights_sha256 != description.get("weights_sha256"):
            raise InputError(f"{file.path}: is damaged (the weights do not match their checksum); {DAMAGED}")
        return model

    @classmethod
    def from_training(cls, entry: Mapping[str, Any], weights: Mapping[str, Tensor], training_data: str) -> Self:
        """The model from the result of a training.

        Args:
            entry: facts that the training recorded, see `TrainingCheckpoint`.
            weights: weights of the network, by name.
            training_data: its training data, in words.

        Raises:
            KeyError: an entry is missing.
            TypeError, ValueError, RuntimeError: entries or weights do not fit.
        """
        network = cls.network_type(config_from_plain(cls.config_type, entry["network_arguments"]))
        network.load_state_dict(weights)
        facts = cls.own_facts(entry)
        return cls(
            network=network.eval(), training_data=training_data, validation=named_numbers(entry, "validation"), **facts
        )


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, shapes and float32 values, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        value = weights[name].detach().to("cpu", torch.float32)
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.contiguous(memory_format=torch.contiguous_format).numpy().tobytes())
    return digest.hexdigest()


def _check_identity(file: WeightsFile, kind: str, expected: Mapping[str, object]) -> None:
    """Raise `InputError` if kind, format version or conventions of the file differ from the expected ones."""
    path, description = file.path, file.description
    if description.get("format") != f"g3r-{kind}":
        instead = f"format is {shown(description.get('format'))}, expected {f'g3r-{kind}'!r}"
        raise InputError(f"{path}: is not a {kind} checkpoint ({instead}); {another_file(kind)}")
    for key, value in expected.items():
        found = description.get(key)
        if type(found) is not type(value) or found != value:  # True equals 1 otherwise
            name, again = key.replace("_", " "), f"train and export a {kind} with this version of g3r"
            raise InputError(f"{path}: {name} is {shown(found)}, this g3r reads {value!r}; {again}")


def _filled(network_type: type[nn.Module], config: NetworkConfig, file: WeightsFile) -> nn.Module:
    """The network with the file's weights; built only after a check that the file holds enough values for it.

    Raises:
        InputError: names, dtypes or shapes do not fit, or weights are NaN or infinite.
    """
    try:
        n_values = sum(math.prod(claim.shape) for claim in file.claims.values())
        if config.min_values() > n_values:
            raise ValueError(f"{n_values} values for at least {config.min_values():.3g}")
        network = network_type(config).eval()
        _check_claims(network, file)
        network.load_state_dict(file.tensors())
    except (G3RError, MemoryError):
        raise
    except Exception as error:  # a constructor with unexpected values may raise anything
        raise InputError(
            f"{file.path}: weights and network arguments do not fit together ({one_line(error)}); {DAMAGED}"
        ) from error
    for name, value in network.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{file.path}: weight {name} holds NaN or infinity; export another checkpoint")
    return network


def _check_claims(network: nn.Module, file: WeightsFile) -> None:
    """Raise `ValueError` if the header's tensors differ from those of the network."""
    expected = network.state_dict()
    wrong = sorted(expected.keys() ^ file.claims.keys())
    if wrong:
        raise ValueError(f"weight {wrong[0][:60]!r} is {'missing' if wrong[0] in expected else 'unknown'}")
    for name, value in expected.items():
        claim = file.claims[name]
        if claim.shape != tuple(value.shape) or claim.dtype.startswith("F") != value.is_floating_point():
            raise ValueError(f"weight {name} is {claim.dtype} {claim.shape}, expected {tuple(value.shape)}")
