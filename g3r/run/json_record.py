"""Dataclasses as JSON and back; a missing field or a wrong type raises an error that names the field."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

Record = TypeVar("Record")


def to_plain(value: Any) -> Any:
    """Dataclasses, sequences and mappings as the dicts, lists and plain values of JSON.

    Raises:
        TypeError: it contains another type.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, str):
        return str(value)
    if is_dataclass(value):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(one) for key, one in value.items()}
    if isinstance(value, Sequence):
        return [to_plain(one) for one in value]
    raise TypeError(f"{type(value).__name__} has no place in a JSON record")


def from_plain(kind: type[Record], value: Any, name: str = "record") -> Record:
    """A value of some type from its JSON.

    Args:
        kind: a dataclass, list, tuple, dict, union with None, `Literal` of strings, plain type or `Any`.
        value: output of `json.loads`.
        name: name of the value, for error messages.

    Raises:
        ValueError: a field is missing, unknown or of another type.
    """
    return _built(kind, value, name)


def _built(kind: Any, value: Any, name: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        return _one_of(arguments, value, name)
    if origin is Literal:
        if value not in arguments:
            raise ValueError(f"{name} is {value!r:.40}; expected {' or '.join(map(repr, arguments))}")
        return value
    if is_dataclass(kind):
        return _dataclass(kind, value, name)
    if origin is list or origin is tuple:
        _check(value, list, name)
        inner = arguments[0]
        return origin(_built(inner, one, f"{name}[{n}]") for n, one in enumerate(value))
    if origin is dict:
        _check(value, dict, name)
        return {key: _built(arguments[1], one, f"{name}.{key}") for key, one in value.items()}
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    _check(value, kind, name)
    return value


def _one_of(kinds: Sequence[Any], value: Any, name: str) -> Any:
    """The value as the first type of a union that accepts it; None only if the union includes None."""
    if value is None and type(None) in kinds:
        return None
    errors = []
    for kind in kinds:
        if kind is type(None):
            continue
        try:
            return _built(kind, value, name)
        except ValueError as error:
            errors.append(error)
    raise errors[0]


def _dataclass(kind: Any, value: Any, name: str) -> Any:
    _check(value, dict, name)
    hints = get_type_hints(kind)
    known = [field for field in fields(kind) if field.init]
    wrong = sorted({field.name for field in known} ^ set(value))
    if wrong:
        raise ValueError(f"{name}: {', '.join(wrong)} missing or unknown")
    return kind(**{key: _built(hints[key], one, f"{name}.{key}") for key, one in value.items()})


def _check(value: Any, kind: type, name: str) -> None:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{name} is {value!r:.40}; expected {kind.__name__}")
