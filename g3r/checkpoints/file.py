"""Files of weights: written whole or not at all, read without executing anything, checked to the last bit."""

import hashlib
import os
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from g3r.checkpoints.archive import check_archive
from g3r.errors import InputError

Network = TypeVar("Network", bound=nn.Module)

LONGEST_TEXT = 10_000
"""Characters of a description."""

MAX_NUMBER = 1e30

LONGEST_LIST = 16
"""Entries of an argument that is a list: levels of a network, axes of a template."""


def write_file(path: Path, content: Mapping[str, Any]) -> None:
    """Write a dict of plain values and tensors; an existing file is replaced.

    Raises:
        InputError: the file cannot be written.
    """
    beside = None
    try:
        descriptor, beside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(descriptor, "wb") as stream:
            torch.save(dict(content), stream)
        Path(beside).chmod(0o644)  # mkstemp makes files that only their owner reads
        Path(beside).replace(path)
    except OSError as error:
        if beside is not None:
            Path(beside).unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose a writable path") from error


def read_file(path: Path, kind: str, another_file: str) -> dict[str, Any]:
    """Return the file's dict, or say in one line why there is none.

    Args:
        path: to read.
        kind: what the file should be, for the message: "prior".
        another_file: what to do when it is something else.

    Raises:
        InputError: missing, unreadable, damaged, or not a dict.
    """
    check_archive(path, kind, another_file)
    try:
        with warnings.catch_warnings(action="ignore"):  # the file's, which a refusal says better
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load says "damaged" in many types
        raise InputError(f"{path}: is damaged or not written by g3r-export; {another_file}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: is not a {kind} checkpoint (holds a {type(content).__name__}); {another_file}")
    return content


def check_identity(
    path: Path, content: Mapping[str, Any], kind: str, expected: Mapping[str, Any], another_file: str
) -> None:
    """Refuse another kind of file, another version of its format, and other conventions.

    Args:
        path: for the message.
        content: of the file.
        kind: "prior" for the format "g3r-prior".
        expected: entries that must hold these values.
        another_file: what to do when it is something else.

    Raises:
        InputError: as said.
    """
    if not _is(content.get("format"), f"g3r-{kind}"):
        if "pytorch-lightning_version" in content:
            raise InputError(f"{path}: is a Lightning training checkpoint; turn it into a {kind} with g3r-export")
        found = f"format is {_shown(content.get('format'))}, expected {f'g3r-{kind}'!r}"
        raise InputError(f"{path}: is not a {kind} checkpoint ({found}); {another_file}")
    for key, value in expected.items():
        if not _is(content.get(key), value):
            name = key.replace("_", " ")
            raise InputError(f"{path}: {name} is {_shown(content.get(key))}, this g3r reads {value!r}; {again(kind)}")


def plain_arguments(content: Mapping[str, Any], largest: Mapping[str, float]) -> dict[str, Any]:
    """The network's arguments as a file gives them: plain numbers within bounds, or short lists of them.

    Args:
        content: of the file.
        largest: of each argument that is a number or a list of numbers; a network is built of these.

    Raises:
        KeyError: the file has none.
        TypeError: something else than numbers.
        ValueError: out of bounds.
    """
    found = content["network_arguments"]
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise TypeError("network arguments are not named")
    for name, value in found.items():
        values = value if isinstance(value, list | tuple) else [value]
        if len(values) > LONGEST_LIST or not all(type(one) in (bool, int, float) for one in values):
            raise TypeError(f"network argument {name[:40]} is {_shown(value)}, expected plain numbers")
        if not all(abs(one) <= largest.get(name, MAX_NUMBER) for one in values):  # NaN is not
            raise ValueError(f"network argument {name[:40]} is {_shown(value)}, out of bounds")
    return dict(found)


def number(content: Mapping[str, Any], key: str) -> float:
    """A plain number of a file; `KeyError` without it, `TypeError` for something else."""
    value = content[key]
    if type(value) not in (int, float) or (type(value) is int and abs(value) > MAX_NUMBER):
        raise TypeError(f"could not convert {key} {_shown(value)} to a number")
    return float(value)


def text(content: Mapping[str, Any], key: str) -> str:
    """A text of a file; `KeyError` without it, `TypeError` for something else."""
    value = content[key]
    if not isinstance(value, str) or len(value) > LONGEST_TEXT:
        raise TypeError(f"{key} is {_shown(value)}, expected a text")
    return value


def scores(content: Mapping[str, Any]) -> dict[str, float]:
    """The validation scores of a file; `KeyError` without them, `TypeError` for something else."""
    found = content["validation"]
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise TypeError(f"validation is {_shown(found)}, expected named scores")
    return {name: number(found, name) for name in found}


def built(
    path: Path, build: Callable[[], Network], min_values: Callable[[], float], content: Mapping[str, Any], kind: str
) -> Network:
    """A network with a file's weights; memory is taken only once the file is known to hold enough to fill it.

    Args:
        path: for the message.
        build: makes the network.
        min_values: a lower bound, about the number of its weights, from the same arguments.
        content: of the file.
        kind: for the message: "prior".

    Raises:
        InputError: arguments that make no network, names or shapes that do not fit, NaN or infinity.
    """
    weights = content["weights"]
    try:
        n_values = 0
        for name, value in weights.items():
            if not isinstance(value, Tensor):
                raise TypeError(f"weight {_shown(name)} is {_shown(value)}")
            if value.numel() * value.element_size() > value.untyped_storage().nbytes():
                raise ValueError(f"weight {_shown(name)} claims more values than the file holds")
            n_values += value.numel()
        if min_values() > n_values:
            raise ValueError(f"{n_values} values for at least {min_values():.3g}")
        network = build()
        network.load_state_dict(dict(weights), strict=True)
    except MemoryError:
        raise
    except Exception as error:  # a constructor given other numbers than it expects may raise anything
        raise InputError(
            f"{path}: weights and network arguments do not fit together ({one_line(error)}); {again(kind)}"
        ) from error
    for name, value in network.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{path}: weight {name} holds NaN or infinity; export another checkpoint")
    return network


def check_digest(path: Path, weights: Mapping[str, Tensor], expected: object) -> None:
    """Raise `InputError` where weights are not those whose digest was written."""
    if weights_digest(weights) != expected:
        raise InputError(f"{path}: is damaged (the weights do not match their checksum); copy or export it again")


def plain_weights(network: nn.Module) -> dict[str, Tensor]:
    """The network's state as row-major float32 on the CPU; memory formats are a matter of the machine."""
    return {
        name: value.detach().to("cpu", torch.float32).clone(memory_format=torch.contiguous_format)
        for name, value in network.state_dict().items()
    }


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, shapes and float32 values, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        value = weights[name].detach().to("cpu", torch.float32)
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.contiguous(memory_format=torch.contiguous_format).numpy().tobytes())
    return digest.hexdigest()


def again(kind: str) -> str:
    """What to do about a file of another version."""
    return f"train and export a {kind} with this version of g3r"


def one_line(error: BaseException) -> str:
    """Return the first 120 characters of an error's text without line breaks."""
    return " ".join(str(error).split())[:120]


def _is(found: object, expected: object) -> bool:
    """Equality that no tensor, and no True for 1, gets past."""
    return type(found) is type(expected) and found == expected


def _shown(value: object) -> str:
    """A value in a message: short, and never the text of a tensor."""
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and abs(value) < 10**30):
        return repr(value)
    return repr(value[:60]) if isinstance(value, str) else f"a {type(value).__name__}"
