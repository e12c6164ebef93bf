"""Loss curves and sections of a reconstruction for TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.errors import InputError


def check_tensorboard(folder: Path) -> None:
    """Raise `InputError` where nothing could be written: before the work, not after it."""
    if find_spec("tensorboard") is None:
        raise InputError("--tensorboard: tensorboard is not installed; pip install tensorboard")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; expected a folder, choose another --tensorboard")


def write_tensorboard(
    folder: Path,
    losses: Mapping[str, Sequence[float | Mapping[str, float]]],
    volume: NDArray[np.float32],
    mask: NDArray[np.bool_],
) -> None:
    """Write the losses of each stage and the middle sections of the volume.

    Args:
        folder: of the event file.
        losses: by stage, a number or named numbers for each step.
        volume: [I, J, K].
        mask: [I, J, K]; the sections go through its middle.
    """
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(folder)) as writer:
        for stage, history in losses.items():
            for step, entry in enumerate(history):
                values = entry if isinstance(entry, Mapping) else {"image": entry}
                for name, value in values.items():
                    writer.add_scalar(f"{stage}/{name}", value, step)
        middle = [int(n.mean()) for n in mask.nonzero()]
        top = float(volume.max()) or 1.0
        for axis, name in enumerate(("sagittal", "coronal", "axial")):
            section = np.take(volume, middle[axis], axis=axis) / top
            writer.add_image(f"volume/{name}", section.T[::-1].copy(), dataformats="HW")
