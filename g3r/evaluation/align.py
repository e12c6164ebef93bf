"""Rigid alignment of a reconstruction to a reference, and resampling on the reference's grid (SimpleITK).

A reconstruction is determined only up to one rigid motion of the whole head, so it is compared after
that motion is removed. ITK works in LPS; the interface of this module is RAS+.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from g3r.acquisition.images import Volume
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.lps import LPS_FROM_RAS, in_lps

logger = logging.getLogger(__name__)

START_ANGLES_DEG = (-25.0, 0.0, 25.0)
"""Start rotations about each axis; with the reach of the coarse level (about 20 degrees) they cover 45 degrees."""

GOOD_ENOUGH_NCC = 0.95
"""If the first start reaches this at the coarse level, the others are not tried."""

N_NEAR = 2
"""Number of first starts, without rotations, which suffice for a volume of known orientation."""

COARSE_SHRINK = 4
SAMPLED_SHARE = 0.15
"""Share of the voxels that the metric uses, on a regular lattice that ITK jitters."""

SAMPLING_SEED = 1
"""Seed of that jitter; ITK's default is the clock, by which no two runs would agree."""


@dataclass(frozen=True)
class Alignment:
    """A rigid motion of the reference's space onto the volume's, and the correlation that it reaches.

    Attributes:
        volume_from_reference: one pose; maps a world point of the reference to that of the volume.
        ncc: absolute correlation in the mask that the registration reached.
        rotation_deg: angle of the motion.
        translation_mm: displacement of the middle of the mask.
    """

    volume_from_reference: RigidPose
    ncc: float
    rotation_deg: float
    translation_mm: float


def align_rigid(volume: Volume, reference: Volume, mask: NDArray[np.bool_], *, near: bool = False) -> Alignment:
    """Find the rigid motion that best correlates a volume with the reference inside its mask.

    Multi-start at a coarse level (centres of mass, headers as they are, then rotations about each
    axis), two fine levels from the best start, and a last optimisation on all voxels. Repeatable to the bit.

    Args:
        volume: the image to be aligned; zero or not finite where it has no data.
        reference: the fixed image.
        mask: bool [I, J, K] on the reference's grid.
        near: whether the volume is known to be aligned within some ten degrees; then no rotations are tried.

    Raises:
        InputError: no start gave an overlap, or a header is sheared.
    """
    fixed, moving = _to_sitk(reference), _to_sitk(volume)
    fixed_mask = _to_sitk(Volume(mask.astype(np.float32), reference.affine, "mask"))
    fixed_mask = sitk.Cast(fixed_mask > 0.5, sitk.sitkUInt8)
    best: tuple[float, sitk.Euler3DTransform] | None = None
    for n, start in enumerate(itertools.islice(_starts(fixed, moving), N_NEAR if near else None)):
        try:
            found = _register(fixed, moving, fixed_mask, start, levels=(COARSE_SHRINK,), n_iterations=40)
        except RuntimeError as error:  # ITK found no overlap
            logger.debug("a start was dropped: %s", " ".join(str(error).split())[-120:])
            continue
        if best is None or found[0] > best[0]:
            best = found
        if n == 0 and best[0] > GOOD_ENOUGH_NCC:
            break
    if best is None:
        raise InputError(
            f"{volume.name}: cannot be aligned with {reference.name}, no start gave an overlap; "
            "check that both show the same brain"
        )
    _, transform = _register(fixed, moving, fixed_mask, best[1], levels=(2, 1), n_iterations=200)
    # sampled metrics leave an error of a tenth of a voxel, visible above 32 dB, so end on all voxels
    ncc, transform = _register(fixed, moving, fixed_mask, transform, levels=(1,), n_iterations=60, step_mm=0.1)
    pose = _pose(transform)
    center = reference.grid.world(np.argwhere(mask).mean(0))
    return Alignment(
        pose,
        ncc,
        rotation_deg=float(np.rad2deg(np.linalg.norm(pose.rotvec_rad()))),
        translation_mm=float(np.linalg.norm(pose.apply(center[None])[0] - center)),
    )


def resample(volume: Volume, grid: VolumeGrid, volume_from_grid: RigidPose | None = None) -> NDArray[np.float32]:
    """A volume's values [I, J, K] at the voxels of another grid, by cubic B-splines; zero outside.

    On the same grid without a motion the values are returned unchanged.

    Args:
        volume: volume to resample; values that are not finite count as zero.
        grid: grid of the result.
        volume_from_grid: one motion of world space, from the grid to the volume; None for no motion.
    """
    same = volume.data.shape == grid.shape and np.allclose(volume.affine, grid.affine, atol=1e-4)
    if volume_from_grid is None and same:
        return np.nan_to_num(volume.data, posinf=0.0, neginf=0.0)
    pose = in_lps(RigidPose.identity(1) if volume_from_grid is None else volume_from_grid)
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(pose.rotation[0].ravel().tolist())
    transform.SetTranslation(pose.translation_mm[0].tolist())
    target = _to_sitk(Volume(np.zeros(grid.shape, np.float32), grid.affine, "grid"))
    moved = sitk.Resample(_to_sitk(volume), target, transform, sitk.sitkBSpline, 0.0)
    return np.ascontiguousarray(sitk.GetArrayFromImage(moved).transpose(2, 1, 0))


def _starts(fixed: sitk.Image, moving: sitk.Image) -> Iterator[sitk.Euler3DTransform]:
    """Start transforms around the middle of the reference's grid, the likeliest first."""
    index = [(n - 1) / 2 for n in fixed.GetSize()]
    middle_mm = fixed.TransformContinuousIndexToPhysicalPoint(index)
    translation_mm = _mass_translation_mm(fixed, moving)
    yield _euler(middle_mm, (0.0, 0.0, 0.0), translation_mm)
    yield _euler(middle_mm, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for angles_deg in itertools.product(START_ANGLES_DEG, repeat=3):
        if any(angles_deg):
            yield _euler(middle_mm, tuple(np.deg2rad(angles_deg)), translation_mm)


def _mass_translation_mm(fixed: sitk.Image, moving: sitk.Image) -> tuple[float, ...]:
    """Translation from the reference's centre of mass to the volume's; zero if a mass is not positive."""
    try:
        moments = sitk.CenteredTransformInitializerFilter.MOMENTS
        return sitk.CenteredTransformInitializer(fixed, moving, sitk.Euler3DTransform(), moments).GetTranslation()
    except RuntimeError:
        return (0.0, 0.0, 0.0)


def _euler(
    center_mm: Sequence[float], angles_rad: Sequence[float], translation_mm: Sequence[float]
) -> sitk.Euler3DTransform:
    transform = sitk.Euler3DTransform()
    transform.SetCenter(center_mm)
    transform.SetRotation(*(float(a) for a in angles_rad))
    transform.SetTranslation(translation_mm)
    return transform


def _register(
    fixed: sitk.Image,
    moving: sitk.Image,
    fixed_mask: sitk.Image,
    start: sitk.Euler3DTransform,
    *,
    levels: tuple[int, ...],
    n_iterations: int,
    step_mm: float | None = None,
) -> tuple[float, sitk.Euler3DTransform]:
    """Optimise from one start; returns the correlation and the transform (fixed to moving).

    With `step_mm`, in small steps on every voxel; otherwise in steps of 1 on a sample of the voxels.
    """
    method = sitk.ImageRegistrationMethod()
    method.SetNumberOfThreads(1)  # sums in one order: the same input gives the same result
    method.SetMetricAsCorrelation()
    if step_mm is None:
        method.SetMetricSamplingStrategy(method.REGULAR)
        method.SetMetricSamplingPercentage(SAMPLED_SHARE, SAMPLING_SEED)
    method.SetMetricFixedMask(fixed_mask)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(
        step_mm or 1.0, 1e-4, n_iterations, gradientMagnitudeTolerance=1e-4 if step_mm is None else 1e-8
    )
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel(levels)
    method.SetSmoothingSigmasPerLevel([level / 2 for level in levels])
    transform = sitk.Euler3DTransform(start)
    method.SetInitialTransform(transform, inPlace=True)
    method.Execute(fixed, moving)
    # ITK minimises minus the squared correlation
    return float(np.sqrt(max(0.0, -method.GetMetricValue()))), transform


def _pose(transform: sitk.Euler3DTransform) -> RigidPose:
    """The RAS pose of ITK's x -> R (x - c) + c + t in LPS."""
    rotation = np.array(transform.GetMatrix()).reshape(3, 3)
    center = np.array(transform.GetCenter())
    shift = np.array(transform.GetTranslation()) + center - rotation @ center
    return in_lps(RigidPose(rotation[None], shift[None]))


def _to_sitk(volume: Volume) -> sitk.Image:
    """The ITK image of a RAS volume; values that are not finite become 0, the value of missing data."""
    spacing = volume.grid.spacing_mm
    lps = LPS_FROM_RAS @ volume.affine
    direction = lps[:3, :3] / spacing
    if volume.grid.shear > 1e-3:
        raise InputError(f"{volume.name}: header is sheared (axes not orthogonal); resample it on an ordinary grid")
    data = np.nan_to_num(volume.data, posinf=0.0, neginf=0.0).astype(np.float32)
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.transpose(2, 1, 0)))
    image.SetSpacing(spacing.tolist())
    image.SetDirection(direction.ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    return image
