"""Records as JSON and back: an equal record, or an error that names the field."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pytest

from g3r.run.json_record import from_plain, to_plain


@dataclass(frozen=True, kw_only=True)
class Inner:
    name: str
    size_mm: float


@dataclass(frozen=True, kw_only=True)
class Outer:
    n: int
    on: bool
    inner: Inner
    maybe: Inner | None = None
    side: Literal["left", "right"] | None = None
    pair: tuple[float, ...] = ()
    rows: list[Inner] = field(default_factory=list)
    by_name: dict[str, list[float]] = field(default_factory=dict)
    anything: Any = None


ONE = Outer(
    n=3,
    on=True,
    inner=Inner(name="a", size_mm=0.1),
    side="left",
    pair=(1.0, 2.5),
    rows=[Inner(name="b", size_mm=1e-300)],
    by_name={"x": [1 / 3]},
    anything={"deep": [1, None, "text"]},
)


def test_a_record_survives_json_to_the_last_bit() -> None:
    assert from_plain(Outer, json.loads(json.dumps(to_plain(ONE)))) == ONE


def test_numbers_of_numpy_become_plain_ones() -> None:
    assert to_plain({"a": np.float64(0.5), "b": [np.int64(2), np.bool_(True)]}) == {"a": 0.5, "b": [2, True]}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"n": "three"}, "record.n is 'three'; expected int"),
        ({"n": True}, "record.n is True; expected int"),
        ({"n": 1.5}, "record.n is 1.5; expected int"),
        ({"on": 1}, "record.on is 1; expected bool"),
        ({"inner": None}, "record.inner is None; expected dict"),
        ({"side": "up"}, "record.side is 'up'; expected 'left' or 'right'"),
        ({"side": ["left"]}, r"record.side is \[.left.\]; expected .left. or .right."),
        ({"inner": {"name": "a"}}, "record.inner: size_mm missing or unknown"),
        ({"rows": [{"name": "a", "size_mm": 1, "more": 2}]}, r"record.rows\[0\]: more missing or unknown"),
        ({"by_name": {"x": ["y"]}}, r"record.by_name.x\[0\] is 'y'; expected float"),
    ],
)
def test_what_does_not_fit_is_named(change: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        from_plain(Outer, {**to_plain(ONE), **change})


def test_what_json_cannot_hold_is_refused() -> None:
    with pytest.raises(TypeError, match="ndarray has no place"):
        to_plain({"a": np.zeros(3)})
