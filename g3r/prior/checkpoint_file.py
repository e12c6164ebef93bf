"""Files of weights: written whole or not at all, read without executing anything, checked to the last bit."""

import hashlib
import os
import pickle
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from g3r.errors import InputError


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
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); choose a writable path"
        ) from error


def read_file(path: Path, kind: str, another_file: str) -> dict[str, Any]:
    """Return the file's dict, or say in one line why there is none.

    Args:
        path: to read.
        kind: what the file should be, for the message: "prior".
        another_file: what to do when it is something else.

    Raises:
        InputError: missing, unreadable, damaged, or not a dict.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; expected a {kind} checkpoint; {another_file}") from error
    except (IsADirectoryError, PermissionError) as error:
        raise InputError(f"{path}: cannot be read ({one_line(error)}); {another_file}") from error
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, OSError) as error:
        # torch.load says "damaged" in many types; what the file begins with tells which advice helps.
        with path.open("rb") as stream:
            is_zip = stream.read(2) == b"PK"
        if is_zip:
            found = "is damaged or not written by g3r-export"
        else:
            found = f"is not a {kind} checkpoint (not a file of torch.save)"
        raise InputError(f"{path}: {found}; {another_file}") from error
    if not isinstance(content, dict):
        raise InputError(
            f"{path}: is not a {kind} checkpoint (holds a {type(content).__name__}); {another_file}"
        )
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
    if content.get("format") != f"g3r-{kind}":
        if "pytorch-lightning_version" in content:
            raise InputError(
                f"{path}: is a Lightning training checkpoint; turn it into a {kind} with g3r-export"
            )
        found = f"format is {content.get('format')!r}, expected {f'g3r-{kind}'!r}"
        raise InputError(f"{path}: is not a {kind} checkpoint ({found}); {another_file}")
    for key, value in expected.items():
        if content.get(key) != value:
            name = key.replace("_", " ")
            raise InputError(
                f"{path}: {name} is {content.get(key)!r}, this g3r reads {value!r}; {again(kind)}"
            )


def fill(path: Path, network: nn.Module, weights: Mapping[str, Any], kind: str) -> None:
    """Put weights into a network and see that they are finite.

    Raises:
        InputError: names or shapes that do not fit, NaN or infinity.
    """
    try:
        network.load_state_dict(dict(weights), strict=True)
    except (TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise InputError(
            f"{path}: weights and network arguments do not fit together ({one_line(error)}); {again(kind)}"
        ) from error
    for name, value in network.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{path}: weight {name} holds NaN or infinity; export another checkpoint")


def check_digest(path: Path, weights: Mapping[str, Tensor], expected: object) -> None:
    """Raise `InputError` where weights are not those whose digest was written."""
    if weights_digest(weights) != expected:
        raise InputError(
            f"{path}: is damaged (the weights do not match their checksum); copy or export it again"
        )


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
