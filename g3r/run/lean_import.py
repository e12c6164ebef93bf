"""Imports of MONAI and nibabel without their optional packages, even if those are installed.

`import monai` tries dozens of optional packages, plotting and statistics among them, and takes twice as long if it
finds them; nibabel tries pydicom. The commands of g3r use none of them through MONAI or nibabel. Elsewhere, such as in
a notebook, they may be in use for other things, so a program has to opt in.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

OPTIONAL = {
    "monai": ("matplotlib", "pandas", "scipy.signal", "scipy.stats", "skimage", "itk", "tqdm"),
    "nibabel": ("pydicom",),
}
"""Optional packages that are hidden while a package is imported."""

_is_asked: list[bool] = []


def import_lean() -> None:
    """Import MONAI and nibabel without their optional packages from now on. For programs, not for libraries."""
    _is_asked[:] = [True]


def load_nibabel() -> None:
    """Import nibabel, without pydicom if a program opted in."""
    with lean("nibabel"):
        import_module("nibabel")


@contextmanager
def lean(package: str = "monai") -> Iterator[None]:
    """Hide the optional packages of a package while the block imports it, if a program opted in.

    Packages that are loaded already stay. A hidden one raises only where the importing package uses it.

    Args:
        package: key of `OPTIONAL`.
    """
    hidden = []
    if _is_asked and package not in sys.modules:
        hidden = [name for name in OPTIONAL[package] if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            if sys.modules.get(name, True) is None:
                del sys.modules[name]
