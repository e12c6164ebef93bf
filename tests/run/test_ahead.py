"""Values computed ahead: once, for all callers, with their errors passed on."""

from __future__ import annotations

import importlib
import sys
import threading
from pathlib import Path

import pytest

from g3r.run.ahead import Ahead, import_ahead


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


def test_modules_are_imported_beside_the_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Users of a module wait until it is imported; a failed import affects only users of that module."""
    text = "import threading, time\ntime.sleep(0.1)\nby = threading.current_thread().name\n"
    (tmp_path / "slow_module.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        import_ahead("slow_module", "no_module_of_this_name")
        for _ in range(10_000):
            if "slow_module" in sys.modules:
                break
            threading.Event().wait(0.001)
        assert importlib.import_module("slow_module").by == "ahead"
    finally:
        sys.modules.pop("slow_module", None)
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("no_module_of_this_name")
