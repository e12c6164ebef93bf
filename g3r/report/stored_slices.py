"""Slices of an earlier run with their pixels: its folder holds none, so the stacks are read again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from g3r.acquisition.planes import Slices
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.other_images import load_images, slices_of


def stored_slices(folder: Path, stacks: Sequence[str | os.PathLike[str]]) -> Slices:
    """Slices [K] in the final poses of a run.

    Args:
        folder: folder of the run.
        stacks: files of the run's stacks, in the same order.

    Raises:
        InputError: the files are not those of the run, or the folder is without reuse.npz.
    """
    run = FinishedRun.load(folder)
    return slices_of(run.geometry, load_images(run, stacks))
