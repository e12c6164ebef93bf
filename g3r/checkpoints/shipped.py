"""The weights that are part of the package: the usual set, and sets with a name of their own."""

from __future__ import annotations

import os
from pathlib import Path

from g3r.checkpoints.weights_file import SUFFIX

WEIGHTS = Path(__file__).parent / "weights"

SET_NAMES = ("cc0",)
"""Named sets hold a file of each kind. `cc0` is trained on data in the public domain alone; the usual set is not."""


def weights_path(source: str | os.PathLike[str] | None, kind: str) -> Path:
    """The file that is meant by a path, by the name of a set, or by None, which is the usual set.

    Args:
        source: as the user gave it.
        kind: "prior", "pose" or "mask".
    """
    if source is None:
        return WEIGHTS / f"{kind}{SUFFIX}"
    if source in SET_NAMES:
        return WEIGHTS / f"{kind}-{source}{SUFFIX}"
    return Path(source)


def set_of(source: object) -> str | None:
    """The name of a set, if it is one: who names it for one kind of weights means it for all."""
    return source if isinstance(source, str) and source in SET_NAMES else None
