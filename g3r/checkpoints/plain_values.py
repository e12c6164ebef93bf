"""Plain values from a description of unknown origin, accepted only if type and range are right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

Config = TypeVar("Config")

MAX_TEXT = 10_000
"""Most characters of a text in a description."""
MAX_NUMBER = 1e30
MAX_LIST = 16
"""Most entries of an argument that is a list: levels of a network, axes of a template."""


def config_from_plain(kind: type[Config], found: object) -> Config:
    """Network arguments as a record, from plain values: all of them, each of its type.

    Args:
        kind: dataclass whose fields are bool, int, float or tuples of int.
        found: plain values that a file or a training holds.

    Raises:
        TypeError: it is not a dict, or a value has another type.
        ValueError: names are missing or unknown, a list is too long, or values are out of range.
    """
    if not isinstance(found, Mapping) or not all(isinstance(name, str) for name in found):
        raise TypeError("network arguments are not named")
    types = get_type_hints(kind)
    wrong = sorted(set(found) ^ set(types))
    if wrong:
        raise ValueError(f"network argument {wrong[0][:40]} is {'missing' if wrong[0] in types else 'unknown'}")
    return kind(**{name: _argument(name, types[name], found[name]) for name in types})


def _argument(name: str, kind: Any, value: Any) -> object:
    is_list = get_origin(kind) is tuple
    values = list(value) if isinstance(value, list | tuple) and is_list else [value]
    wanted = get_args(kind)[0] if is_list else kind
    allowed = (int, float) if wanted is float else (wanted,)
    if is_list != isinstance(value, list | tuple) or not all(type(one) in allowed for one in values):
        expected = f"a list of {wanted.__name__}" if is_list else wanted.__name__
        raise TypeError(f"network argument {name} is {shown(value)}, expected {expected}")
    if len(values) > MAX_LIST or not all(abs(one) <= MAX_NUMBER for one in values):  # false for NaN
        raise ValueError(f"network argument {name} is {shown(value)}, out of bounds")
    return tuple(values) if is_list else wanted(value)


def number(content: Mapping[str, Any], key: str) -> float:
    """A plain number of a description; `KeyError` without it, `TypeError` for something else."""
    value = content[key]
    if type(value) not in (int, float) or (type(value) is int and abs(value) > MAX_NUMBER):
        raise TypeError(f"could not convert {key} {shown(value)} to a number")
    return float(value)


def text(content: Mapping[str, Any], key: str) -> str:
    """A text of a description; `KeyError` without it, `TypeError` for something else."""
    value = content[key]
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise TypeError(f"{key} is {shown(value)}, expected a text")
    return value


def numbers(content: Mapping[str, Any], key: str) -> tuple[float, ...]:
    """A list of plain numbers; `KeyError` without it, `TypeError` for something else."""
    found = content[key]
    if not isinstance(found, list | tuple):
        raise TypeError(f"{key} is {shown(found)}, expected a list of numbers")
    return tuple(number({key: one}, key) for one in found)


def named_numbers(content: Mapping[str, Any], key: str) -> dict[str, float]:
    """Numbers by name, such as scores; `KeyError` without them, `TypeError` for something else."""
    found = content[key]
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise TypeError(f"{key} is {shown(found)}, expected named numbers")
    return {name: number(found, name) for name in found}


def shown(value: object) -> str:
    """A value for a message, shortened."""
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and abs(value) < 10**30):
        return repr(value)
    return repr(value[:60]) if isinstance(value, str) else f"a {type(value).__name__}"
