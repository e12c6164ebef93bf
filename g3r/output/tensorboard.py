"""Check that TensorBoard can be written; `live_board` writes it. Nothing heavy is imported here."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from g3r.errors import InputError
from g3r.run.output_folder import SUFFIX


def check_tensorboard(folder: Path, output: Path) -> None:
    """Raise `InputError` if TensorBoard could not be written, before the work begins.

    Args:
        folder: folder to write into.
        output: folder of the result, which must not contain it, because the result is put in place as a whole.
    """
    if find_spec("tensorboard") is None:
        raise InputError("--tensorboard: tensorboard is not installed; pip install tensorboard")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; expected a folder, choose another --tensorboard")
    place, result = Path(os.path.realpath(folder)), Path(os.path.realpath(output))
    for taken in (result, result.with_name(result.name + SUFFIX)):
        if place.is_relative_to(taken):
            raise InputError(
                f"{folder}: is written while the run goes on, and lies in {taken.name}, which is put in place at its "
                "end; choose another folder for --tensorboard"
            )
