"""The weights that ship with the package: the usual set, and named sets."""

from __future__ import annotations

import os
from pathlib import Path

from g3r.checkpoints.weights_file import SUFFIX

WEIGHTS = Path(__file__).parent / "weights"

SET_NAMES = ("cc0",)
"""Names of further sets of weights. `cc0` is trained on data in the public domain alone; the usual set is not."""


def weights_path(source: str | os.PathLike[str] | None, kind: str) -> Path:
    """The file of a source: a path, the name of a set, or None for the usual set.

    Args:
        source: as given by the user.
        kind: "prior", "pose" or "mask".
    """
    if source is None:
        return WEIGHTS / f"{kind}{SUFFIX}"
    if source in SET_NAMES:
        return WEIGHTS / f"{kind}-{source}{SUFFIX}"
    return Path(source)


def set_of(source: object) -> str | None:
    """The source if it is the name of a set: a set named for one kind of weights applies to all kinds."""
    return source if isinstance(source, str) and source in SET_NAMES else None
