"""Scores of a volume as in the paper, in the mask of the truth and on its whole grid."""

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
from g3r.evaluation.metrics import Scores, correlation, mean_ssim, psnr_db, score
from g3r.geometry import RigidPose, VolumeGrid
from studies.harness import Row
from studies.runs import aligned


@functools.lru_cache(maxsize=1)
def metric(weights: Path | None) -> Lpips:
    """LPIPS with weights from files, read once per process."""
    return Lpips.load(weights)


def why_no_lpips(weights: Path | None) -> str:
    """The reason why LPIPS cannot be measured here; empty if it can."""
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
    *,
    near: bool = True,
) -> tuple[Row, Comparison]:
    """Scores in the mask of the truth ("mask") and on its whole grid ("grid"), and the aligned and scaled volume.

    In the mask, gain and offset are fitted, as everywhere in g3r; on the grid, only a factor.

    Args:
        case: with the truth.
        data: [I, J, K] of the volume.
        grid: of the data.
        truth_from_volume: the common motion of the slices, from which the alignment starts.
        lpips: the metric; None leaves it out.
        known: alignment to use, of a volume from the same slices in the same poses; None searches for it.
        near: whether the search relies on `truth_from_volume` (`align_rigid`).
    """
    if known is None:
        found = aligned(case, data, grid, truth_from_volume, near=near)
    else:
        volume = Volume(data, grid.moved(truth_from_volume).affine, case.name)
        moved = resample(volume, case.truth.grid, known.volume_from_reference)
        scores = score(moved, case.truth.data, case.truth_mask)
        found = Comparison(scores, known, (moved * scores.gain + scores.offset).astype(np.float32))
    truth, mask = case.truth.data.astype(np.float64) / found.scores.data_range, case.truth_mask
    fitted = found.volume.astype(np.float64) / found.scores.data_range
    row: Row = {"mask": _figures(found.scores), "grid": _on_grid(fitted, truth, found.scores)}
    if lpips is not None:
        row["mask"]["lpips"] = round(lpips.distance(fitted, truth, mask), 5)
        everywhere = np.ones(mask.shape, bool)
        row["grid"]["lpips"] = round(lpips.distance(_scaled(fitted, truth, found.scores), truth, everywhere), 5)
    return row, found


def _scaled(fitted: NDArray[np.float64], truth: NDArray[np.float64], scores: Scores) -> NDArray[np.float64]:
    """The volume without the fitted offset, times the least-squares factor to the truth on the whole grid.

    There is no offset, so that black voxels stay black, as the truth is outside the brain.

    Args:
        fitted: [I, J, K] the volume with gain and offset of the scores, divided by the data range.
        truth: [I, J, K] divided by the data range.
        scores: in the mask.
    """
    given = fitted - scores.offset / scores.data_range
    power = float((given**2).sum())
    return given * (float((given * truth).sum()) / power if power > 0 else 0.0)


def _on_grid(fitted: NDArray[np.float64], truth: NDArray[np.float64], scores: Scores) -> dict[str, float]:
    """Scores over all voxels; for arguments see `_scaled`."""
    scaled, everywhere = _scaled(fitted, truth, scores), np.ones(truth.shape, bool)
    rmse = float(np.sqrt(((scaled - truth) ** 2).mean()))
    return {
        "psnr_db": round(psnr_db(rmse), 4),
        "ssim": round(mean_ssim(scaled, truth, everywhere), 5),
        "ncc": round(correlation(scaled.ravel(), truth.ravel()), 5),
        "rmse": round(rmse, 5),
    }


def _figures(scores: Scores) -> dict[str, float]:
    return {
        "psnr_db": round(scores.psnr_db, 4),
        "ssim": round(scores.ssim, 5),
        "ncc": round(scores.ncc, 5),
        "rmse": round(scores.rmse, 5),
    }
