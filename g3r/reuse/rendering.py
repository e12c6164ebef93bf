"""The volume of a finished run on any grid, without a new fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.images import Space, Volume
from g3r.acquisition.nifti import MAX_VOXEL_COUNT
from g3r.acquisition.stack_checks import ORTHOGONALITY_TOLERANCE
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid
from g3r.reuse.finished_run import FinishedRun

RESOLUTION_RANGE_MM = (0.1, 10.0)
"""Accepted voxel sizes of a rendered volume; `g3r-infer` itself accepts a narrower range."""


@dataclass(frozen=True)
class Target:
    """The grid of a rendered volume, in the space of the file and in that of the run.

    Attributes:
        written: grid of the file, in `space`.
        evaluated: the same voxels in the space of the run.
        space: space of the file's affine.
    """

    written: VolumeGrid
    evaluated: VolumeGrid
    space: Space


def target_grid(
    run: FinishedRun, resolution_mm: float | None = None, like: Volume | None = None, space: Space | None = None
) -> Target:
    """The grid of a rendered volume.

    Args:
        run: the run to render.
        resolution_mm: voxel size over the run's field of view; None takes that of the run.
        like: an image whose grid is used instead of a resolution.
        space: space of the file (and of `like`); the run's when None. The run's voxels are moved to another space by
            their affine alone, so that nothing is resampled.

    Raises:
        InputError: a resolution out of range, too many voxels, sheared axes, or a space unknown to the run.
    """
    space = run.space if space is None else space
    run_from_space = RigidPose.identity(1)
    if space != run.space:
        found = run.standard_from_scanner
        if found is None:
            raise InputError(
                f"{run.folder}: is in scanner space, where the standard orientation is not known; leave --space out, "
                "or run g3r-infer with --space standard"
            )
        run_from_space = found
    if like is not None:
        written, evaluated = like.grid, like.grid.moved(run_from_space)
        if written.shear > ORTHOGONALITY_TOLERANCE:
            raise InputError(
                f"{like.name}: its axes are sheared (cosine {written.shear:.2g}); expected at most "
                f"{ORTHOGONALITY_TOLERANCE:g}, pass an image with orthogonal axes"
            )
    else:
        resolution_mm = float(run.geometry.grid.spacing_mm[0]) if resolution_mm is None else resolution_mm
        low, high = RESOLUTION_RANGE_MM
        if not low <= resolution_mm <= high:
            raise InputError(f"resolution {resolution_mm:g} mm; expected {low:g} to {high:g} mm")
        evaluated = run.geometry.grid.respaced(resolution_mm)
        written = evaluated.moved(run_from_space.inverse())
    if math.prod(written.shape) > MAX_VOXEL_COUNT:
        shape = " x ".join(map(str, written.shape))
        raise InputError(f"a volume of {shape} voxels; expected at most {MAX_VOXEL_COUNT}, choose a coarser grid")
    return Target(written, evaluated, space)


def render_volume(run: FinishedRun, grid: VolumeGrid) -> NDArray[np.float32]:
    """The volume [I, J, K] on a grid in the run's space, in the stacks' intensities.

    On the run's own grid it is `volume.nii.gz` (to rounding: prior.nii.gz holds scaled intensities).

    Args:
        run: has Gaussians, prior and density.
        grid: grid with orthogonal axes.

    Raises:
        InputError: a file of the run is missing or damaged.
    """
    mixture = run.mixture
    volume = mixture.volume(run.cloud, grid)
    if not run.record.settings.fill_unseen:
        volume = volume * mixture.seen(grid)
    return volume * np.float32(run.geometry.intensity_scale)
