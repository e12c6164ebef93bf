"""Values made ahead: once, wherever they are asked for, with their errors."""

from __future__ import annotations

import threading

import pytest

from g3r.run.ahead import Ahead


def test_made_once_when_it_is_asked_for() -> None:
    made: list[str] = []

    def make() -> int:
        made.append(threading.current_thread().name)
        return 7

    one = Ahead(make)
    assert made == []
    assert one.value() == one.value() == 7
    one.start()
    assert made == [threading.current_thread().name]


def test_made_beside_the_caller_and_waited_for() -> None:
    go, names = threading.Event(), []

    def make() -> str:
        names.append(threading.current_thread().name)
        assert go.wait(10)
        return "made"

    one = Ahead(make)
    one.start()
    one.start()
    threading.Timer(0.05, go.set).start()
    assert one.value() == "made"
    assert names == ["ahead"]


def test_an_error_comes_out_where_the_value_is_asked_for() -> None:
    def fail() -> int:
        raise ValueError("no")

    one = Ahead(fail)
    one.start()
    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            one.value()
