"""Reconstructions of a small head under changes that should have no effect, and diverging fits."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.stacks import Stack
from g3r.errors import NumericalError
from g3r.fitting import divergence_guard as divergence_guard
from g3r.fitting.fit_context import FitContext
from g3r.fitting.parameters import LearningRates
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings, fit_slices
from g3r.gaussians import render
from g3r.gaussians.seeding import seed_cloud
from g3r.geometry import RigidPose, VolumeGrid
from g3r.output.result import ReconstructionResult
from g3r.reconstruct import GaussianReconstructor
from g3r.registration.settings import RegistrationSettings
from tests.numerics.scenes import ORIGIN_MM, head_scene, single, stacks_of_planes
from tests.quick import QUICK_FIT

HEAD_RADIUS_MM = 10.0
NOISE = 0.02
SCANNER_UNITS = 700.0

SETTINGS = replace(
    QUICK_FIT,
    gaussian_spacing_pixels=2.0,
    registration=RegistrationSettings(
        template=False, network=False, stacks=False, segments=False, n_rounds=2, standard_orientation=False
    ),
)
"""The shortest preset, with slices registered from their header poses: no search, no template."""


def small_stacks(factor: float = 1.0, motion: RigidPose | None = None) -> list[Stack]:
    """Three stacks of one small head with scaled intensities, after a rigid motion of the whole world.

    Pixels are bit-identical to those of the unmoved world, since only headers move.
    """
    scene = head_scene()
    noise = np.random.default_rng(3).normal(0, NOISE, scene.planes.n_pixels)
    pixels = render(single(scene.cloud), scene.planes).numpy() + noise.astype(np.float32)
    away = scene.planes.pixel_world_mm() - ORIGIN_MM
    inside = np.linalg.norm(away, axis=1) < HEAD_RADIUS_MM
    planes = scene.planes if motion is None else scene.planes.moved(motion)
    values = (pixels * np.float32(SCANNER_UNITS)) * np.float32(factor)
    return [_stack(planes, values, inside, n) for n in range(3)]


def _stack(planes: Planes, pixels: NDArray[np.float32], inside: NDArray[np.bool_], number: int) -> Stack:
    n = len(planes) // 3
    own = np.arange(number * n, (number + 1) * n)
    rotation, center = planes.rotation[own[0]], planes.center_mm[own]
    step = (center[-1] - center[0]) / (n - 1)
    shape = planes.shape[own[0]]
    affine = np.eye(4)
    affine[:3, :2] = rotation[:, :2] * planes.spacing_mm[own[0]]
    affine[:3, 2] = step
    affine[:3, 3] = center[0] - affine[:3, :2] @ ((shape - 1) / 2)
    begin, end = planes.offset[own[0]], planes.offset[own[-1] + 1]

    def volume(array: NDArray) -> NDArray:
        return array[begin:end].reshape(n, *shape).transpose(1, 2, 0)

    return Stack(
        image=volume(pixels),
        mask=volume(inside),
        affine=affine,
        thickness_mm=float(np.linalg.norm(step)),
        name=f"stack-{number}.nii.gz",
    )


def reconstruction(factor: float = 1.0, motion: RigidPose | None = None) -> ReconstructionResult:
    """Reconstruction of the small head by the whole pipeline."""
    return GaussianReconstructor(settings=SETTINGS).reconstruct(small_stacks(factor, motion))


CHANGES: dict[str, tuple[float, RigidPose | None]] = {
    "intensities times 2^-20": (2.0**-20, None),
    "intensities times 1e-6": (1e-6, None),
    "intensities times 1e6": (1e6, None),
    "world shifted by 10 m": (1.0, RigidPose.from_rotvec([[0.0, 0, 0]], [[1e4, -1e4, 1e4]])),
    "world turned by 90 degrees": (1.0, RigidPose.from_rotvec([[0.0, 0, np.pi / 2]], [[0.0, 0, 0]])),
    "world turned by 37 degrees": (1.0, RigidPose.from_rotvec([[0.3, -0.5, 0.28]], [[0.0, 0, 0]])),
}


def volume_changes() -> list[dict[str, Any]]:
    """Differences of the head to the plain reconstruction for each change, relative to the 99th percentile.

    Both clouds are rendered at the same points of the head, which move with the world. For comparison, rows have the
    mean error against the truth before and after.
    """
    plain = reconstruction()
    points = _points(plain)
    scale = float(np.percentile(plain.volume[plain.mask], 99))
    first = _values(plain, points, None)
    truth = render(head_scene().cloud, points, backend="reference").numpy() * SCANNER_UNITS
    rows: list[dict[str, float | str]] = [
        {"change": "none", "mean": 0.0, "largest": 0.0, "error": float(np.abs(first - truth).mean()) / scale}
    ]
    for name, (factor, motion) in CHANGES.items():
        value = _values(reconstruction(factor, motion), points, motion) / factor
        change, error = np.abs(value - first) / scale, np.abs(value - truth) / scale
        rows.append(
            {"change": name, "mean": float(change.mean()), "largest": float(change.max()), "error": float(error.mean())}
        )
    return rows


def _points(result: ReconstructionResult) -> Planes:
    """Planes of single pixels at voxels well inside the head."""
    world = result.grid.world(np.argwhere(result.mask))
    world = world[np.linalg.norm(world - ORIGIN_MM, axis=1) < HEAD_RADIUS_MM - 2][::7]
    n = len(world)
    return Planes(
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        center_mm=world,
        spacing_mm=np.ones((n, 2)),
        shape=np.ones((n, 2), np.int64),
        psf_var_mm2=np.zeros((n, 3)),
    )


def _values(result: ReconstructionResult, points: Planes, motion: RigidPose | None) -> NDArray[np.float64]:
    moved = points if motion is None else points.moved(motion)
    return render(result.cloud, moved).numpy().astype(np.float64) * result.intensity_scale


def times(factor: float) -> LearningRates:
    """All step sizes times a factor."""
    rates = LearningRates()
    return LearningRates(**{field.name: factor * getattr(rates, field.name) for field in fields(rates)})


def slices_of_small_head(noise: float = NOISE) -> tuple[Slices, VolumeGrid, NDArray[np.float32], NDArray[np.bool_]]:
    """Slices of the small head about the origin, and a blurred version of it with mask on a grid."""
    scene = head_scene(np.zeros(3))
    planes = stacks_of_planes(np.zeros(3))
    rng = np.random.default_rng(4)
    value = render(single(scene.cloud), planes).numpy()
    value = value + rng.normal(0, noise, len(value)).astype(np.float32)
    n = len(planes) // 3
    slices = Slices(
        planes=planes,
        value=value,
        mask=np.linalg.norm(planes.pixel_world_mm(), axis=1) < HEAD_RADIUS_MM,
        stack_id=np.repeat(np.arange(3), n),
        slice_index=np.tile(np.arange(n), 3),
        thickness_mm=np.full(3 * n, 2.2),
        header_pose=planes.pose,
    )
    grid = VolumeGrid.isotropic([-HEAD_RADIUS_MM] * 3, [HEAD_RADIUS_MM] * 3, 1.0)
    index = np.stack(np.meshgrid(*[np.arange(m) for m in grid.shape], indexing="ij"), -1)
    mask = np.linalg.norm(grid.world(index), axis=-1) < HEAD_RADIUS_MM
    guess = np.full(grid.shape, float(np.abs(slices.masked_value).mean()), np.float32)
    return slices, grid, guess, mask


def fit_at(factor: float, guarded: bool = True, n_steps: int = 60) -> SliceFit:
    """A slice fit with all step sizes times a factor, with or without the divergence guard."""
    slices, grid, guess, mask = slices_of_small_head()
    ones = np.ones(len(slices))
    settings = SliceStageSettings(n_steps=n_steps, rates=times(factor))
    before = divergence_guard.RISE
    try:
        if not guarded:
            divergence_guard.RISE = math.inf
        return fit_slices(
            seed_cloud(guess, mask, grid, 2.5),
            slices,
            gain=ones,
            weight=ones,
            prior=None,
            settings=settings,
            context=FitContext(rng=np.random.default_rng(0)),
        )
    finally:
        divergence_guard.RISE = before


def step_size_rows() -> list[dict[str, float]]:
    """Final errors of fits with too large step sizes, with and without rollbacks."""
    rows = []
    for factor in (1.0, 10.0, 100.0):
        for guarded in (True, False):
            row: dict[str, float] = {"factor": factor, "guarded": guarded, "back": 0}
            try:
                fit = fit_at(factor, guarded)
            except NumericalError:
                row |= {"first": math.nan, "most": math.nan, "residual": math.nan}
            else:
                image = [entry["image"] for entry in fit.history]
                row |= {"first": image[0], "most": max(image), "residual": image[-1]}  # with gains and fields
                row["back"] = fit.n_rollbacks
            rows.append(row)
    return rows
