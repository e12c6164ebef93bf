"""The slices of an earlier run with their pixels, which its folder does not hold, read from the stacks again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from g3r.acquisition.planes import Slices
from g3r.reuse.finished_run import FinishedRun
from g3r.reuse.other_images import load_images, slices_of


def stored_slices(folder: Path, stacks: Sequence[str | os.PathLike[str]]) -> Slices:
    """Slices [K] in the last poses of a run.

    Args:
        folder: of the run.
        stacks: its files, in its order.

    Raises:
        InputError: other files than those of the run, or a folder without reuse.npz.
    """
    run = FinishedRun.load(folder)
    return slices_of(run.geometry, load_images(run, stacks))
