"""Comparison of two volumes in a mask: resample them on one grid, then score."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.errors import InputError
from g3r.evaluation.align import Alignment, align_rigid, resample
from g3r.evaluation.metrics import Scores, score

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Comparison:
    """Scores, the motion that was removed first (if any), and the volume as scored.

    Attributes:
        scores: see `Scores`.
        alignment: None if the headers were used as they are.
        volume: float32 [I, J, K] on the reference's grid, intensities fitted to the reference.
    """

    scores: Scores
    alignment: Alignment | None
    volume: NDArray[np.float32]


def compare(
    volume: Volume, reference: Volume, mask: NDArray[np.bool_], *, align: bool = False, near: bool = False
) -> Comparison:
    """Score a volume against a reference in the mask of the reference.

    Args:
        volume: the volume to score.
        reference: the volume to compare with.
        mask: bool [I, J, K] on the grid of the reference.
        align: remove a rigid motion first; otherwise the headers are used as they are.
        near: see `align_rigid`.

    Raises:
        InputError: the volume has no finite values, the reference is not finite or not positive in the
            mask, or the volumes do not overlap.
    """
    n_bad = int((~np.isfinite(volume.data)).sum())
    if n_bad == volume.data.size:
        raise InputError(f"{volume.name}: holds no finite value; nothing to score")
    if n_bad:
        logger.warning("%s: %d values are not finite and count as 0", volume.name, n_bad)
    inside = reference.data[mask]
    if not np.isfinite(inside).all():
        raise InputError(f"{reference.name}: has values that are not finite in the mask; choose another reference")
    if np.percentile(inside, 99.9) <= 0:
        raise InputError(f"{reference.name}: is not positive in the mask; check that the mask belongs to it")
    alignment = align_rigid(volume, reference, mask, near=near) if align else None
    moved = resample(volume, reference.grid, alignment.volume_from_reference if alignment else None)
    if not moved[mask].any():
        raise InputError(
            f"{volume.name}: is zero all over the mask of {reference.name}; check the headers or pass --align"
        )
    scores = score(moved, reference.data, mask)
    return Comparison(scores, alignment, (moved * scores.gain + scores.offset).astype(np.float32))
