"""Values that take seconds to compute, computed in a background thread while other work goes on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from importlib import import_module
from threading import Lock, Thread
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Ahead(Generic[Value]):
    """A lazily computed value that a background thread can compute in advance.

    Args:
        make: computes the value; `value` raises its exceptions.
    """

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make = make
        self._lock = Lock()
        self._made: Future[Value] | None = None

    def start(self) -> None:
        """Start computing the value in a background thread, a daemon that does not keep the program from ending."""
        future, is_new = self._future()
        if is_new:
            Thread(target=self._run, args=(future,), name="ahead", daemon=True).start()

    def value(self) -> Value:
        """The value; waits if a thread is computing it, and computes it here if none has started."""
        future, is_new = self._future()
        if is_new:
            self._run(future)
        return future.result()

    def _future(self) -> tuple[Future[Value], bool]:
        with self._lock:
            is_new = self._made is None
            self._made = self._made or Future()
            return self._made, is_new

    def _run(self, future: Future[Value]) -> None:
        try:
            future.set_result(self._make())
        except BaseException as error:
            future.set_exception(error)


def import_ahead(*modules: str) -> None:
    """Start importing modules in a background thread. Importing holds Python's global lock only part of the time.

    Args:
        modules: names; a failed import is reported where the module is used.
    """
    Ahead(lambda: [import_module(name) for name in modules]).start()
