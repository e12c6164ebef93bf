"""The format of exported weights: safetensors, with a JSON description in the header. Nothing in it is executed.

A file may come from any source. Its header is read first, and the dtypes, shapes and sizes that it claims must agree
with the length of the file before the rest is read.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from g3r.errors import InputError
from g3r.run.atomic_file import atomic_path

if TYPE_CHECKING:
    from torch import Tensor

SUFFIX = ".safetensors"
DESCRIPTION_KEY = "g3r"
"""Entry of the header's `__metadata__` that holds the description, as JSON."""

MAX_HEADER_BYTES = 1_000_000
"""Limit of a header; our files have about 30 kB."""
MAX_FILE_BYTES = 1_000_000_000
MAX_AXES = 8

BYTES_PER_VALUE = {"F16": 2, "F32": 4, "I64": 8}
"""The dtypes in use, as safetensors names them: weights, and counters of batches."""


class DamagedError(ValueError):
    """The content of a file is inconsistent."""


@dataclass(frozen=True)
class TensorClaim:
    """Dtype and shape of a tensor as the header states them."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def n_bytes(self) -> int:
        """Size in the file."""
        return math.prod(self.shape) * BYTES_PER_VALUE[self.dtype]


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightsFile:
    """A file of exported weights whose header has been checked; the tensors are decoded on demand.

    It can be read without torch, and handed to `TrainedModel.load` later.

    Attributes:
        path: path of the file.
        description: description of the weights; only known to be a dict.
        claims: dtype and shape of each tensor by name; together they fill the file.
        sha256: SHA-256 of all bytes of the file.
        content: all bytes of the file.
    """

    path: Path
    description: dict[str, Any]
    claims: dict[str, TensorClaim]
    sha256: str
    content: bytes = field(repr=False)

    def tensors(self) -> dict[str, Tensor]:
        """Decode all tensors.

        Raises:
            DamagedError: offsets overlap or leave gaps.
        """
        from safetensors import SafetensorError
        from safetensors.torch import load

        try:
            return load(self.content)
        except SafetensorError as error:
            raise DamagedError(str(error)) from error


def read_weights(path: Path, kind: str) -> WeightsFile:
    """Read a file of exported weights; open and hash it once.

    Args:
        path: file to read.
        kind: expected kind of the file, for messages, such as "prior".

    Raises:
        InputError: the file is missing, unreadable or of another format, or its header does not fit it.
    """
    advice = another_file(kind)
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # opening a pipe would wait for its other end
            raise OSError("not a regular file")
        with path.open("rb") as stream:
            return _read(stream, path, kind)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a {kind} checkpoint; {advice}") from None
    except DamagedError as error:
        raise InputError(f"{path}: is damaged or not written by g3r-export ({error}); {advice}") from None
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        found = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({found}); {advice}") from None


def _read(stream: BinaryIO, path: Path, kind: str) -> WeightsFile:
    n_file = os.fstat(stream.fileno()).st_size
    start = stream.read(8)
    if start.startswith(b"PK\x03\x04"):
        raise InputError(
            f"{path}: is a file of torch.save (a training checkpoint, or weights of an earlier g3r); export the "
            f"run's .ckpt again with g3r-export, and pass the {SUFFIX} file"
        )
    n_header = int.from_bytes(start, "little")
    first = stream.read(1)
    if len(start) < 8 or first != b"{":
        raise InputError(f"{path}: is not a {kind} checkpoint (not a {SUFFIX[1:]} file); {another_file(kind)}")
    if n_header > min(MAX_HEADER_BYTES, n_file - 8) or n_file > MAX_FILE_BYTES:
        raise DamagedError(f"a header of {n_header} bytes in a file of {n_file}")
    header = first + stream.read(n_header - 1)
    metadata, claims = _checked_header(header)
    if DESCRIPTION_KEY not in metadata:
        raise InputError(f"{path}: is not a {kind} checkpoint (not written by g3r); {another_file(kind)}")
    n_values = sum(claim.n_bytes for claim in claims.values())
    if 8 + n_header + n_values != n_file:
        raise DamagedError(f"{8 + n_header + n_values} bytes expected, {n_file} found")
    description = _parsed(metadata[DESCRIPTION_KEY])
    content = start + header + stream.read(n_values)
    if len(content) != n_file:
        raise DamagedError("it changes while it is read")
    return WeightsFile(
        path=path, description=description, claims=claims, sha256=hashlib.sha256(content).hexdigest(), content=content
    )


def _checked_header(header: bytes) -> tuple[dict[str, Any], dict[str, TensorClaim]]:
    """The header's metadata and claims; raises `DamagedError` if it is not a safetensors header."""
    entries = _parsed(header)
    metadata = entries.pop("__metadata__", {})
    if not isinstance(metadata, dict):
        raise DamagedError("metadata without names")
    claims = {}
    for name, entry in entries.items():
        found = entry if isinstance(entry, dict) else {}
        dtype, shape = found.get("dtype"), found.get("shape")
        if not isinstance(dtype, str) or dtype not in BYTES_PER_VALUE:
            raise DamagedError(f"weight {name[:40]!r} has no dtype that g3r writes")
        if not isinstance(shape, list) or len(shape) > MAX_AXES:
            raise DamagedError(f"weight {name[:40]!r} has no shape")
        if not all(type(n) is int and 0 <= n <= MAX_FILE_BYTES for n in shape):
            raise DamagedError(f"weight {name[:40]!r} has no shape")
        claims[name] = TensorClaim(dtype, tuple(shape))
    return metadata, claims


def _parsed(text: object) -> dict[str, Any]:
    """Parse a JSON object."""
    try:
        value = json.loads(text)  # type: ignore[arg-type]
    except (TypeError, ValueError, RecursionError):
        raise DamagedError("the header is not JSON") from None
    if not isinstance(value, dict):
        raise DamagedError("the header is not a JSON object")
    return value


def write_weights(path: Path, description: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write a file of weights, whole or not at all; an existing one is replaced.

    Args:
        path: file to write.
        description: plain values that JSON can hold.
        tensors: contiguous, on the CPU, of the dtypes in `BYTES_PER_VALUE`.

    Raises:
        InputError: the file cannot be written.
    """
    from safetensors.torch import save

    # a single entry: the library writes several in random order, and equal weights should give equal bytes
    content = save(dict(tensors), {DESCRIPTION_KEY: json.dumps(description)})
    try:
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose a writable path") from error


def another_file(kind: str) -> str:
    """Advice for a file that is not an exported network of this kind."""
    return f"pass a {kind} network made by g3r-export, or leave it out to use the one that ships with g3r"
