"""Values that take seconds to make, made ahead in a thread of their own while something else is under way."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from importlib import import_module
from threading import Lock, Thread
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Ahead(Generic[Value]):
    """A value that is made once: when it is asked for, or before.

    Args:
        make: makes it; what it raises, `value` raises.
    """

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make = make
        self._lock = Lock()
        self._made: Future[Value] | None = None

    def start(self) -> None:
        """Begin to make it, beside what the caller does next. The thread does not keep the program from ending."""
        future, is_new = self._future()
        if is_new:
            Thread(target=self._run, args=(future,), name="ahead", daemon=True).start()

    def value(self) -> Value:
        """The value; waits for it where it is being made, and makes it here where nobody has begun."""
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
    """Begin to import modules that will be needed later, which hold Python's lock only in part.

    Args:
        modules: names; one that cannot be imported says so where it is used.
    """
    Ahead(lambda: [import_module(name) for name in modules]).start()
