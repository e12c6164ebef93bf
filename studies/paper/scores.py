"""Scores of a volume as the paper has them, in the mask of the truth and on its whole grid."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.errors import InputError
from g3r.evaluation.align import Alignment, resample
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.compare import Comparison
from g3r.evaluation.lpips import Lpips
from g3r.evaluation.metrics import Scores, score
from g3r.geometry import RigidPose, VolumeGrid
from studies.harness import Row
from studies.runs import aligned

PLACES = ("mask", "grid")
"""In the mask of the truth, and on the whole grid, with what a method shows beside the brain."""


@functools.lru_cache(maxsize=1)
def metric(weights: Path | None) -> Lpips:
    """LPIPS with the weights of files, read once in a process."""
    return Lpips.load(weights)


def why_no_lpips(weights: Path | None) -> str:
    """Why LPIPS cannot be measured here; empty where it can."""
    try:
        metric(weights)
    except InputError as error:
        return str(error)
    return ""


def scored(
    case: SimulatedCase,
    data: NDArray[np.float32],
    grid: VolumeGrid,
    truth_from_volume: RigidPose,
    lpips: Lpips | None,
    known: Alignment | None = None,
) -> tuple[Row, Comparison]:
    """Scores by place, and the volume as it was scored.

    Args:
        case: with the truth.
        data: [I, J, K] of the volume.
        grid: of the data.
        truth_from_volume: the common motion of the slices, from where the alignment starts.
        lpips: the metric; None leaves it out.
        known: alignment of a volume of the same slices in the same poses, which is then taken; found when None.
    """
    if known is None:
        found = aligned(case, data, grid, truth_from_volume)
    else:
        volume = Volume(data, grid.moved(truth_from_volume).affine, case.name)
        moved = resample(volume, case.truth.grid, known.volume_from_reference)
        scores = score(moved, case.truth.data, case.truth_mask)
        found = Comparison(scores, known, (moved * scores.gain + scores.offset).astype(np.float32))
    truth, everywhere = case.truth.data, np.ones(case.truth_mask.shape, bool)
    row: Row = {}
    for place, mask in zip(PLACES, (case.truth_mask, everywhere), strict=True):
        scores = found.scores if place == "mask" else score(found.volume, truth, mask)
        row[place] = _figures(scores)
        if lpips is not None:
            fitted = found.volume if place == "mask" else found.volume * scores.gain + scores.offset
            distance = lpips.distance(fitted / scores.data_range, truth / scores.data_range, mask)
            row[place]["lpips"] = round(distance, 5)
    return row, found


def _figures(scores: Scores) -> dict[str, float]:
    return {
        "psnr_db": round(scores.psnr_db, 4),
        "ssim": round(scores.ssim, 5),
        "ncc": round(scores.ncc, 5),
        "rmse": round(scores.rmse, 5),
    }
