"""MONAI and nibabel without the packages that they would import because they happen to be installed.

`import monai` tries dozens of optional packages, plotting and statistics among them, and takes twice as long for those
that it finds; nibabel tries pydicom. A command of g3r uses nothing of them through these two. Elsewhere, in a notebook
say, they may be in use for other things, so that a program has to ask for this.
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
"""What is hidden of which package's import."""

_is_asked: list[bool] = []


def import_lean() -> None:
    """From now on networks are imported without what MONAI could do besides. For programs, not for libraries."""
    _is_asked[:] = [True]


def load_nibabel() -> None:
    """Import nibabel, without DICOM where a program asked for lean imports."""
    with lean("nibabel"):
        import_module("nibabel")


@contextmanager
def lean(package: str = "monai") -> Iterator[None]:
    """Hide optional packages of another one while the block imports it, where a program asked for that.

    What is loaded already stays as it is. The package says what is missing where it is used.

    Args:
        package: of `OPTIONAL`.
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
