"""Slice-to-volume reconstruction of fetal brain MRI: thick moving slices in, one isotropic volume out.

from g3r import GaussianReconstructor, load_stack
result = GaussianReconstructor().reconstruct([load_stack("a.nii.gz"), load_stack("b.nii.gz")])
result.save("out")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from g3r._version import __version__
from g3r.run.kernel_cache import ensure_kernel_cache

if TYPE_CHECKING:
    from g3r.acquisition.stacks import load_stack
    from g3r.reconstruct import GaussianReconstructor
    from g3r.reuse.slice_input import read_slice_folder

__all__ = ["GaussianReconstructor", "__version__", "load_stack", "read_slice_folder"]

ensure_kernel_cache()  # before any kernel is declared

# Resolved on first use (PEP 562), so that `import g3r` stays quick and pulls no torch.
_HOME = {
    "GaussianReconstructor": "g3r.reconstruct",
    "load_stack": "g3r.acquisition.stacks",
    "read_slice_folder": "g3r.reuse.slice_input",
}


def __getattr__(name: str) -> object:
    """Import a public name from its home when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted(__all__)
