"""Whether TensorBoard can be written; `live_board` writes it. Nothing heavy is imported here."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from g3r.errors import InputError


def check_tensorboard(folder: Path) -> None:
    """Raise `InputError` where nothing could be written: before the work, not after it."""
    if find_spec("tensorboard") is None:
        raise InputError("--tensorboard: tensorboard is not installed; pip install tensorboard")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; expected a folder, choose another --tensorboard")
