"""Measures of an automatic brain mask against the true mask, and common options of the mask studies."""

from __future__ import annotations

import argparse
import hashlib
import time
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.checkpoints.shipped import weights_path
from g3r.errors import InputError
from studies.harness import Record, Row
from studies.tables import Cell

if TYPE_CHECKING:
    from g3r.mask_network.model import MaskModel

OPTIONS: dict[str, dict[str, Any]] = {
    "--masks": {"metavar": "MASK.safetensors", "help": "mask networks (None: those shipped)"}
}
LOST_PIXELS = 50
"""A slice is lost if it has more brain pixels than this and none of them was found."""


def settings(options: argparse.Namespace) -> Record:
    """The weights that rows were measured with.

    Raises:
        InputError: no such file.
    """
    path = weights_path(options.masks, "mask")
    if not path.is_file():
        raise InputError(f"--masks {path}: no such file; export a checkpoint of the mask networks and name it")
    return {"mask_weights": hashlib.sha256(path.read_bytes()).hexdigest()[:16]}


@cache
def mask_model(source: str | None) -> MaskModel:
    """The mask network of a file, read once."""
    from g3r.mask_network.model import MaskModel

    return MaskModel.load(source)


def scored(image: NDArray[np.float32], true: NDArray[np.bool_], spacing_mm: Sequence[float], source: str | None) -> Row:
    """Find the brain in a stack and compare it with the true mask.

    Args:
        image: [I, J, K].
        true: [I, J, K]; empty if the stack shows no head.
        spacing_mm: [3].
        source: file of the mask network.
    """
    from g3r.mask_network.inference import find_brain

    model = mask_model(source)
    start = time.perf_counter()
    found = find_brain(image, spacing_mm, model)
    seconds = time.perf_counter() - start
    row: Row = {
        "head": bool(true.any()),
        "found": found.found,
        "presence": round(found.presence, 3),
        "volume_ml": round(found.volume_ml, 1),
        "seconds": round(seconds, 2),
        "reason": found.reason,
    }
    if not true.any():
        return row
    off = np.argwhere(true).mean(0) * np.asarray(spacing_mm) - found.centre_mm
    centre_mm = round(float(np.linalg.norm(off)), 2) if found.found else None
    return {**row, **overlap(found.mask, true, spacing_mm), "centre_mm": centre_mm}


def overlap(found: NDArray[np.bool_], true: NDArray[np.bool_], spacing_mm: Sequence[float]) -> Row:
    """Compare a mask with the true one.

    Args:
        found: [I, J, K].
        true: [I, J, K], not empty.
        spacing_mm: [3].
    """
    area, shared = true.sum((0, 1)), (true & found).sum((0, 1))
    return {
        "true_ml": round(float(true.sum() * np.prod(spacing_mm) / 1000), 1),
        "dice": round(float(2 * shared.sum() / (true.sum() + found.sum())), 4),
        "recall": round(float(shared.sum() / true.sum()), 4),
        "lost_slices": int(((area > LOST_PIXELS) & (shared == 0)).sum()),
    }


def line(key: str, row: Row) -> str:
    """Progress line of a finished stack."""
    if not row["head"]:
        return f"{key}: no head, {'one found' if row['found'] else 'none found'}, {row['seconds']:.1f} s"
    off = "-" if row["centre_mm"] is None else f"{row['centre_mm']:.1f} mm"
    return (
        f"{key}: Dice {row['dice']:.3f}, recall {row['recall']:.3f}, centre {off}, {row['lost_slices']} slices lost, "
        f"{row['true_ml']:.0f} ml, {row['seconds']:.1f} s"
    )


EACH: dict[str, Cell] = {
    "stack": "{name}",
    "true ml": "{true_ml:.0f}",
    "found ml": "{volume_ml:.0f}",
    "Dice": "{dice:.3f}",
    "recall": "{recall:.3f}",
    "slices lost": "{lost_slices}",
    "centre mm": lambda row: "-" if row.get("centre_mm") is None else f"{row['centre_mm']:.1f}",
    "presence": "{presence:.2f}",
    "s": "{seconds:.1f}",
}
"""Columns of a table of stacks."""
