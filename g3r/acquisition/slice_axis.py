"""The axis of a file across its slices: by its spacings, its header, or its sidecar, or else a guess with a remark."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.nifti import open_nifti
from g3r.acquisition.sidecar import AXES, read_sidecar, sidecar_path
from g3r.acquisition.slice_profile import LENGTHS_AGREE
from g3r.acquisition.stack_checks import spaced

CLEARLY = 1.1
"""A spacing that is longer than the others by more than this factor is that of slices, not of pixels."""

DECISIVE = 1.5
"""Pixels are not longer than wide by this factor: a header that says so was not turned with its image."""


@dataclass(frozen=True)
class SliceAxis:
    """The axis of a file, 0 to 2, along which slices are counted, and a remark where that is doubtful."""

    axis: int
    remark: str | None = None


def find_slice_axis(path: str | os.PathLike[str], spacing_mm: NDArray[np.float64]) -> SliceAxis:
    """The axis across the slices of a stack.

    It is the one whose spacing is clearly above the others, else the one that the header names (dim_info), else the
    only one whose spacing is the sidecar's `SpacingBetweenSlices`, else the third, with a remark.

    Args:
        path: of the image; its sidecar is beside it.
        spacing_mm: [3] along the axes of the file.

    Raises:
        InputError: the image is none; or neither spacings nor header tell, and the sidecar cannot be used.
    """
    said: int | None = open_nifti(path)[0].header.get_dim_info()[2]
    longest, excess = int(np.argmax(spacing_mm)), float(np.max(spacing_mm) / np.median(spacing_mm))
    if excess > CLEARLY:
        if said is None or said == longest or excess > DECISIVE:
            return SliceAxis(longest)
        return SliceAxis(
            longest,
            f"slices are taken along axis {AXES[longest]} of the file, whose spacing is the longest "
            f"({spaced(spacing_mm)} mm), but its header names axis {AXES[said]} (dim_info); mend the one that is wrong",
        )
    if said is not None:
        return SliceAxis(said)
    sidecar = read_sidecar(sidecar_path(path))
    if sidecar is not None and sidecar.spacing_mm is not None:
        alike = np.flatnonzero(np.abs(spacing_mm - sidecar.spacing_mm) <= LENGTHS_AGREE * spacing_mm)
        if len(alike) == 1:
            return SliceAxis(int(alike[0]))
    return SliceAxis(2, None if _is_odd(spacing_mm, 2) else _guess(spacing_mm))


def _is_odd(spacing_mm: NDArray[np.float64], axis: int) -> bool:
    """Whether the spacing of an axis is clearly below the others, as that of overlapping slices is."""
    return float(spacing_mm[axis]) * CLEARLY < float(np.delete(spacing_mm, axis).min())


def _guess(spacing_mm: NDArray[np.float64]) -> str:
    return (
        f"slices are taken along axis k of the file: spacings do not tell ({spaced(spacing_mm)} mm), nor does its "
        "header; name the axis there (dim_info; nibabel: header.set_dim_info(slice=2) for k)"
    )
