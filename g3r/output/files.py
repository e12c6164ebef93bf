"""The files of an output folder: their names, and the table of slices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.run.log_file import LOG_NAME

MASK_PICTURE = "masks.png"

REUSE_NAME = "reuse.npz"
"""Numbers that other commands need of a finished run; see `ReuseRecord`."""

REPORT_NAME = "report.html"
"""The page to look at first; written by the command, see `g3r.report`."""

MASK_NAMES = (MASK_PICTURE, *(f"brain-mask-{n}.nii.gz" for n in range(32)))
"""Masks that were found, by the number of the stack in slices.tsv; not written for the user's own masks."""

OUTPUT_NAMES = (
    "volume.nii.gz",
    "mask.nii.gz",
    "prior.nii.gz",
    "coarse.nii.gz",
    "density.nii.gz",
    "uncertainty.nii.gz",
    "prior_share.nii.gz",
    "unseen.nii.gz",
    "gaussians.npz",
    REUSE_NAME,
    "slices.tsv",
    "run.json",
    "sections.png",
    REPORT_NAME,
    LOG_NAME,
    *MASK_NAMES,
)

SLICE_COLUMNS = ("stack", "slice", "rx", "ry", "rz", "tx", "ty", "tz", "gain", "weight", "ncc", "reason")

FULL_WEIGHT = 0.99
"""Slices with a smaller weight get a reason in slices.tsv."""

LOST_SIGNAL_GAIN, SMALL_SHARE, POOR_NCC = 0.6, 0.3, 0.8
"""A down-weighted slice has lost signal if its gain is below the first number times the median gain of its stack. It is
small if it has less than the second times its stack's median number of pixels. It does not fit if its correlation with
the volume is below the third."""


def slice_table(
    slices: Slices, gain: NDArray[np.float64], weight: NDArray[np.float64], ncc: NDArray[np.float64]
) -> str:
    """Text of slices.tsv: a point at x by the file's header lies at R x + t (rotation vector in rad, mm).

    Args:
        slices: K slices in their final poses.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        ncc: [K] correlation with the volume.
    """
    motion = slices.world_from_header()
    rotvec = motion.rotvec_rad()
    n_pixels = np.bincount(slices.pixel_plane, minlength=len(slices))
    lines = ["\t".join(SLICE_COLUMNS)]
    for k in range(len(slices)):
        pose = [f"{x:.9g}" for x in (*rotvec[k], *motion.translation_mm[k])]
        figures = [f"{x:.4g}" for x in (gain[k], weight[k], ncc[k])]
        reason = "-"
        if weight[k] < FULL_WEIGHT:
            same = slices.stack_id == slices.stack_id[k]
            usual_gain, typical = np.median(gain[same]), float(np.median(n_pixels[same]))
            reason = _reason(gain[k] / usual_gain, ncc[k], n_pixels[k] / typical)
        lines.append("\t".join([str(slices.stack_id[k]), str(slices.slice_index[k]), *pose, *figures, reason]))
    return "\n".join(lines) + "\n"


def _reason(gain: float, ncc: float, size_share: float) -> str:
    """Why a slice is down-weighted, as far as its figures show."""
    if gain < LOST_SIGNAL_GAIN:
        return "signal loss"
    if size_share < SMALL_SHARE:
        return "does not fit, small slice"
    return "does not fit" if ncc < POOR_NCC else "high residual"
