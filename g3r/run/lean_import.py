"""MONAI without the packages that it would import because they happen to be installed.

`import monai` tries dozens of optional packages, plotting and statistics among them, and takes twice as long for those
that it finds. A command of g3r uses nothing of them through MONAI. Elsewhere, in a notebook say, MONAI may be in use
for other things, so that a program has to ask for this.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

OPTIONAL = ("matplotlib", "pandas", "scipy.signal", "scipy.stats", "skimage", "itk", "tqdm")

_is_asked: list[bool] = []


def import_lean() -> None:
    """From now on networks are imported without what MONAI could do besides. For programs, not for libraries."""
    _is_asked[:] = [True]


@contextmanager
def lean() -> Iterator[None]:
    """Hide optional packages of MONAI while the block imports it, where a program asked for that.

    What is loaded already stays as it is. MONAI says what is missing where it is used.
    """
    hidden = [name for name in OPTIONAL if name not in sys.modules] if _is_asked and "monai" not in sys.modules else []
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            if sys.modules.get(name, True) is None:
                del sys.modules[name]
