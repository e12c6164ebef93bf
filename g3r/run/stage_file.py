"""Stage results as files: an .npz with the arrays, and with the records around them as JSON. No code is run."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.run.atomic_file import atomic_path
from g3r.run.on_demand import is_tensor, torch

TREE = "tree"

Arrays = dict[str, Any]


class UnreadableStage(Exception):
    """The file is truncated, or is not a stage file."""


def write_stage(path: Path, value: Any) -> None:
    """Write records, arrays, tensors, lists, tuples, dicts with text keys, and plain values; whole or not at all.

    Raises:
        OSError: the file cannot be written.
        TypeError: it contains another type.
    """
    arrays: Arrays = {}
    tree = json.dumps(_packed(value, arrays, {})).encode()
    buffer = io.BytesIO()
    arrays[TREE] = np.frombuffer(tree, np.uint8)
    np.savez(buffer, **arrays)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_stage(path: Path, records: Sequence[type]) -> Any:
    """Read what `write_stage` wrote.

    Args:
        path: the stage file.
        records: dataclasses that may be in it.

    Raises:
        UnreadableStage: the file is truncated, or is not a stage file.
    """
    known = {record.__name__: record for record in records}
    damaged = (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        return _unpacked(json.loads(arrays.pop(TREE).tobytes()), arrays, known)
    except damaged as error:
        raise UnreadableStage(f"{path}: {error}") from None


def as_stored(value: Any) -> Any:
    """A value as its file would return it, because sums over arrays may depend on their order in memory."""
    arrays: Arrays = {}
    records: dict[str, type] = {}
    tree = _packed(value, arrays, records)
    return _unpacked(tree, arrays, records)


def _in_order(array: NDArray[Any]) -> NDArray[Any]:
    """The array, or a copy in C order if a file cannot keep its order."""
    return array if array.flags.forc else np.ascontiguousarray(array)


def _packed(value: Any, arrays: Arrays, records: dict[str, type]) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [_packed(one, arrays, records) for one in value]
    if isinstance(value, tuple):
        return {"tuple": [_packed(one, arrays, records) for one in value]}
    if isinstance(value, dict):
        return {"dict": {str(key): _packed(one, arrays, records) for key, one in value.items()}}
    if isinstance(value, np.ndarray) or is_tensor(value):
        name = f"array{len(arrays)}"
        kind = "array" if isinstance(value, np.ndarray) else "tensor"
        arrays[name] = _in_order(value if isinstance(value, np.ndarray) else value.detach().cpu().numpy())
        return {kind: name}
    if is_dataclass(value):
        records[type(value).__name__] = type(value)
        content = {field.name: _packed(getattr(value, field.name), arrays, records) for field in fields(value)}
        return {"record": type(value).__name__, "fields": content}
    raise TypeError(f"{type(value).__name__} has no place in a stage's file")


def _unpacked(tree: Any, arrays: Arrays, known: dict[str, type]) -> Any:
    if isinstance(tree, list):
        return [_unpacked(one, arrays, known) for one in tree]
    if not isinstance(tree, dict):
        return tree
    if "tuple" in tree:
        return tuple(_unpacked(one, arrays, known) for one in tree["tuple"])
    if "dict" in tree:
        return {key: _unpacked(one, arrays, known) for key, one in tree["dict"].items()}
    if "array" in tree:
        return arrays[tree["array"]]
    if "tensor" in tree:
        return torch.from_numpy(arrays[tree["tensor"]])
    content = {key: _unpacked(one, arrays, known) for key, one in tree["fields"].items()}
    return known[tree["record"]](**content)
