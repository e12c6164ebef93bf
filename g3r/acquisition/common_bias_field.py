"""The bias field that all stacks have in common: what their mutual agreement cannot tell from anatomy (N4).

Fields of single stacks follow from where stacks disagree (`StackBiasField`), up to what they share. That part is
left in the volume. N4 finds it in the volume alone: a smooth field whose removal makes the peaks of the histogram
narrower.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from g3r.acquisition.planes import Slices
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box

WORKING_VOXEL_MM = 3.2
"""N4 sees voxels of about this size: a coil's field is smooth."""

CONTROL_POINTS = 4
"""Of the cubic B-spline along each axis, of which four are the fewest: about a quadratic over the head."""

ITERATIONS = (100, 10)
"""Largest numbers on one level of control points and on the next, twice as fine. Weak fields converge in 20 on the
first level, strong ones need more; more on the second take anatomy for a field (heads of docs/stress.md)."""

MIN_VOXELS = 200
"""Fewer working voxels have no histogram."""


def common_log_field(volume: NDArray[np.floating], brain: NDArray[np.bool_], grid: VolumeGrid) -> NDArray[np.float32]:
    """Logarithm [I, J, K] of the smooth intensity field of a volume, with zero mean over the brain.

    Outside the brain it keeps to the range that it has inside. Zero everywhere where the brain is too small or too
    flat to tell.

    Args:
        volume: [I, J, K], positive where there is tissue.
        brain: [I, J, K] where the field is estimated.
        grid: of both.

    Source: Tustison et al., IEEE TMI 29 (2010), as SimpleITK has it.
    """
    import SimpleITK as sitk

    field = np.zeros(volume.shape, np.float32)
    step = [max(1, round(WORKING_VOXEL_MM / mm)) for mm in grid.spacing_mm]
    usable = brain & (volume > 0)
    coarse = tuple(slice(n // 2, None, n) for n in step)
    if usable[coarse].sum() < MIN_VOXELS or np.ptp(volume[usable]) == 0:
        return field
    box = bounding_box(usable)
    if min(a.stop - a.start for a in box) < CONTROL_POINTS * max(step):
        return field
    image = sitk.GetImageFromArray(np.ascontiguousarray(volume[box].T, np.float32))
    mask = sitk.GetImageFromArray(np.ascontiguousarray(usable[box].T.astype(np.uint8)))
    for item in (image, mask):
        item.SetSpacing(grid.spacing_mm.tolist())
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations(list(ITERATIONS))
    n4.SetNumberOfControlPoints([CONTROL_POINTS] * 3)
    n4.SetMaskLabel(1)
    n4.SetNumberOfThreads(1)  # the same sums on every machine
    n4.Execute(sitk.Shrink(image, step), sitk.Shrink(mask, step))
    found = sitk.GetArrayFromImage(n4.GetLogBiasFieldAsImage(image)).T
    inside = found[usable[box]]
    if not np.isfinite(inside).all():
        return field
    low, high, mean = float(inside.min()), float(inside.max()), float(inside.mean())
    # the spline is an extrapolation beyond the brain
    wide = [(a.start, n - a.stop) for a, n in zip(box, volume.shape, strict=True)]
    field[:] = np.pad(np.nan_to_num(found).clip(low, high) - mean, wide, mode="edge")
    return field


def without_field(slices: Slices, log_field: NDArray[np.float32], grid: VolumeGrid) -> Slices:
    """The slices with a field of the volume divided out, at the middle of each pixel.

    Args:
        slices: K slices in place.
        log_field: [I, J, K] from `common_log_field`.
        grid: of the field.
    """
    index = grid.index(slices.planes.pixel_world_mm()).T
    at_pixel = map_coordinates(log_field, index, order=1, mode="nearest", output=np.float32)
    return replace(slices, value=(slices.value * np.exp(-at_pixel)).astype(np.float32))
