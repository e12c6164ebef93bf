"""torch, imported on first use: the import takes seconds, and a preview needs none of it.

    from g3r.run.on_demand import torch

Modules with subclasses of torch's classes import torch as usual, and are imported on demand themselves.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

__all__ = ["is_tensor", "threads_of_torch", "torch"]

_n_threads: list[int] = []
"""Number of torch's threads, once it is set."""


class _OnDemand:
    """Proxy that imports torch on the first access to one of its names."""

    def __getattr__(self, name: str) -> Any:
        value = getattr(loaded_torch(), name)
        if not name.startswith("_"):
            setattr(self, name, value)
        return value

    def __repr__(self) -> str:
        return "<torch, on demand>"


def loaded_torch() -> Any:
    """Return torch, imported if necessary, with the number of threads that was set before."""
    is_new = "torch" not in sys.modules
    module = importlib.import_module("torch")
    if is_new and _n_threads:
        module.set_num_threads(_n_threads[-1])
    return module


def threads_of_torch(n_threads: int) -> None:
    """Give torch's thread pool a number of threads, now or when it is imported.

    Args:
        n_threads: at least 1.
    """
    _n_threads[:] = [n_threads]
    if "torch" in sys.modules:
        loaded_torch().set_num_threads(n_threads)


def is_tensor(value: object) -> bool:
    """Whether a value is a tensor; False while torch is not loaded."""
    return "torch" in sys.modules and isinstance(value, loaded_torch().Tensor)


if TYPE_CHECKING:
    import torch
else:
    torch = _OnDemand()
