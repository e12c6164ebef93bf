"""The bias field that all stacks share, found by N4 in the volume.

Fields of single stacks follow from where stacks disagree (`StackBiasField`). What all stacks share shows in no
disagreement, so it cannot be told from anatomy that way and stays in the volume. N4 finds it in the volume alone: a
smooth field whose removal narrows the peaks of the histogram.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from g3r.acquisition.planes import Slices
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import bounding_box

CONTROL_POINTS = 4
"""Control points of the cubic B-spline along each axis: four, the fewest possible; about a quadratic over the head."""

MIN_VOXELS = 200
"""Fewest working voxels that give a histogram."""


@dataclass(frozen=True, kw_only=True)
class N4Look:
    """One configuration of N4.

    Attributes:
        blur_mm: standard deviation of the Gaussian with which the volume is blurred first.
        depth_mm: only voxels deeper inside the brain than this are used.
        voxel_mm: approximate size of the working voxels; a coil's field is smooth.
        iterations: largest numbers on the first level of control points and on the second, which is twice as fine.
    """

    blur_mm: float = 0.0
    depth_mm: float = 0.0
    voxel_mm: float
    iterations: tuple[int, int]


LOOKS = (
    # weak fields converge in 20 on the first level, strong ones need more; more on the second level fit anatomy
    N4Look(voxel_mm=3.2, iterations=(100, 10)),
    N4Look(blur_mm=2.0, depth_mm=2.4, voxel_mm=4.8, iterations=(50, 5)),
)
"""Sharp, and blurred: blur separates tissues less well but hides folds. The errors of both have little in common."""


def common_log_field(volume: NDArray[np.floating], brain: NDArray[np.bool_], grid: VolumeGrid) -> NDArray[np.float32]:
    """Logarithm [I, J, K] of the smooth intensity field of a volume, with zero mean over the brain.

    N4 runs twice (`LOOKS`). The result is the mean of both fields, shrunk the more they differ relative to its size:
    where there is no field, N4 finds one of 1 to 2 % in the anatomy, a different one each time.

    Outside the brain the field keeps to its range inside. It is zero everywhere if the brain is too small or has no
    contrast.

    Args:
        volume: [I, J, K], positive where there is tissue.
        brain: [I, J, K] where the field is estimated.
        grid: of both.

    Source: Tustison et al., IEEE TMI 29 (2010), as SimpleITK has it.
    """
    usable = brain & (volume > 0)
    if usable.sum() < MIN_VOXELS:
        return np.zeros(volume.shape, np.float32)
    box = bounding_box(usable)
    seen, usable = volume[box].astype(np.float32, copy=False), usable[box]
    with ThreadPoolExecutor(len(LOOKS)) as pool:  # N4 runs on one thread and releases the GIL
        found = [
            one for one in pool.map(lambda look: _n4(seen, usable, grid.spacing_mm, look), LOOKS) if one is not None
        ]
    field = _as_far_as_alike(found, usable) if found else np.zeros_like(seen)
    wide = [(part.start, n - part.stop) for part, n in zip(box, volume.shape, strict=True)]
    return np.pad(field, wide, mode="edge")


def _as_far_as_alike(fields: Sequence[NDArray[np.float32]], usable: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Mean of fields times s / (s + v), where s is its mean square and v the mean variance between the fields."""
    mean = np.mean(fields, axis=0)
    mean -= mean[usable].mean()
    if len(fields) == 1:
        return mean
    size = float(np.mean(mean[usable] ** 2, dtype=np.float64))
    doubt = float(np.var([one[usable] for one in fields], axis=0, ddof=1, dtype=np.float64).mean())
    return np.asarray(mean * np.float32(size / max(size + doubt, np.finfo(float).tiny)))


def _n4(
    volume: NDArray[np.float32], usable: NDArray[np.bool_], spacing_mm: NDArray[np.float64], look: N4Look
) -> NDArray[np.float32] | None:
    """The log field that one configuration of N4 finds; None where the voxels are too few or without contrast."""
    import SimpleITK as sitk

    step = [max(1, round(look.voxel_mm / mm)) for mm in spacing_mm]
    if look.depth_mm > 0:
        usable = distance_transform_edt(np.pad(usable, 1), sampling=spacing_mm)[1:-1, 1:-1, 1:-1] > look.depth_mm
    coarse = tuple(slice(n // 2, None, n) for n in step)
    if usable[coarse].sum() < MIN_VOXELS or np.ptp(volume[usable]) == 0:
        return None
    if min(volume.shape) < CONTROL_POINTS * max(step):
        return None
    seen = gaussian_filter(volume, look.blur_mm / spacing_mm) if look.blur_mm > 0 else volume
    image = sitk.GetImageFromArray(np.ascontiguousarray(seen.T))
    mask = sitk.GetImageFromArray(np.ascontiguousarray(usable.T.astype(np.uint8)))
    for item in (image, mask):
        item.SetSpacing(spacing_mm.tolist())
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations(list(look.iterations))
    n4.SetNumberOfControlPoints([CONTROL_POINTS] * 3)
    n4.SetMaskLabel(1)
    n4.SetNumberOfThreads(1)  # the same sums on every machine
    n4.Execute(sitk.Shrink(image, step), sitk.Shrink(mask, step))
    field = sitk.GetArrayFromImage(n4.GetLogBiasFieldAsImage(image)).T
    inside = field[usable]
    if not np.isfinite(inside).all():
        return None
    # beyond the brain the spline extrapolates
    return np.asarray(np.nan_to_num(field).clip(inside.min(), inside.max()) - inside.mean(), np.float32)


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
