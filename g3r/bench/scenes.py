"""Synthetic clouds and slices: a head of any number of Gaussians, and scenes in which one size grows at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices, volume_planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud, find_overlaps, render
from g3r.gaussians.arrays import CloudArrays, PlaneArrays
from g3r.gaussians.kernels import PROJECTION, project
from g3r.geometry import VolumeGrid

SEMI_AXES_MM = np.array([40.0, 48.0, 38.0])
"""Semi-axes of the ellipsoid that `head_scene` fills with Gaussians."""

SIGMA_PER_SPACING, LOG_SIGMA_SPREAD = 0.6, 0.25
"""Sigma of its Gaussians over the lattice spacing, as the fit seeds them; standard deviation of ln sigma."""

HEAD_THICKNESS_MM = 2.2

CUBE_MM = 50.0
"""Edge of the cube that holds Gaussians, slices and voxels of the growing scenes."""

SIGMA_MM = 1.2
THICKNESS_MM = 2.5

PIXEL_MM = 0.8
"""Pixel size for the in-plane PSF, whatever the pixel spacing: finer pixels must not change the scene."""

FRAMES = (
    np.eye(3),
    Rotation.from_euler("x", 90, degrees=True).as_matrix(),
    Rotation.from_euler("y", 90, degrees=True).as_matrix(),
)
"""Rotations of three orthogonal stacks."""


@dataclass(frozen=True)
class HeadScene:
    """A cloud and three stacks of its slices; each slice is cropped to the head and slightly tilted."""

    cloud: GaussianCloud
    slices: Slices


def head_scene(n_gaussians: int, n_slices: int | None = None, seed: int = 0) -> HeadScene:
    """Random Gaussians that fill an ellipsoid, and slices of noise (their values do not matter).

    Args:
        n_gaussians: Gaussians in the head; their number determines their size.
        n_slices: slices of each stack; None covers the head.
        seed: seed of all random numbers.
    """
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n_gaussians, 3))
    points *= (rng.random(n_gaussians) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    points = (points * SEMI_AXES_MM)[np.lexsort(np.rint(points * SEMI_AXES_MM / 4).T)]  # neighbours adjacent in memory
    spacing_mm = float(4 / 3 * np.pi * SEMI_AXES_MM.prod() / n_gaussians) ** (1 / 3)
    log_scale = np.log(SIGMA_PER_SPACING * spacing_mm) + rng.normal(0, LOG_SIGMA_SPREAD, (n_gaussians, 3))
    cloud = _cloud(points, log_scale, rng.normal(size=(n_gaussians, 4)), rng.uniform(0, 1, n_gaussians))
    rotation, center, shape, stack = [], [], [], []
    for number, frame in enumerate(FRAMES):
        reach = np.abs(frame.T) @ SEMI_AXES_MM
        n = n_slices or int(2 * reach[2] / HEAD_THICKNESS_MM)
        for i in range(n):
            offset = (i - (n - 1) / 2) * HEAD_THICKNESS_MM
            width = np.sqrt(max(1 - (offset / reach[2]) ** 2, 0.02))
            rotation.append(frame @ Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix())
            center.append(frame[:, 2] * offset)
            shape.append(np.maximum(2, 2 * reach[:2] * width / PIXEL_MM))
            stack.append(number)
    k = len(stack)
    spacing = np.full((k, 2), PIXEL_MM)
    variance = psf_variance_mm2(spacing, np.full(k, HEAD_THICKNESS_MM))
    planes = Planes(
        rotation=np.array(rotation),
        center_mm=np.array(center),
        spacing_mm=spacing,
        shape=np.array(shape, dtype=np.int64),
        psf_var_mm2=variance,
    )
    value = rng.random(planes.n_pixels, dtype=np.float32)
    return HeadScene(cloud, _slices(planes, value, np.array(stack), HEAD_THICKNESS_MM))


@dataclass(frozen=True)
class SceneSize:
    """The sizes of a scene.

    Args:
        n_gaussians: of constant size in the same cube, so that each touches a constant number of planes and pixels.
        n_slices: slices through the same cube, in three stacks.
        n_pixels: pixels per slice, over the same area.
        n_voxels: voxels of the volume, over the same cube.
    """

    n_gaussians: int = 8000
    n_slices: int = 48
    n_pixels: int = 4096
    n_voxels: int = 125_000


def made_cloud(size: SceneSize) -> GaussianCloud:
    """Gaussians at random in the cube, their axes 0.8 to 1.25 times the common sigma."""
    rng = np.random.default_rng(0)
    n = size.n_gaussians
    mean = rng.uniform(-CUBE_MM / 2, CUBE_MM / 2, (n, 3))
    log_scale = np.log(SIGMA_MM) + rng.uniform(np.log(0.8), np.log(1.25), (n, 3))
    return _cloud(mean, log_scale, rng.standard_normal((n, 4)), rng.uniform(0.5, 1.0, n) * (8000 / n))


def made_slices(size: SceneSize, cloud: GaussianCloud) -> Slices:
    """Slices of a cloud in three orthogonal stacks, with noise.

    Args:
        size: number of slices and of their pixels.
        cloud: imaged cloud.
    """
    rng = np.random.default_rng(1)
    per_stack = [len(part) for part in np.array_split(np.arange(size.n_slices), len(FRAMES))]
    stack_id = np.repeat(np.arange(len(FRAMES)), per_stack)
    rotation = np.array(FRAMES)[stack_id]
    offset = np.concatenate([(np.arange(n) + 0.5) / max(n, 1) * CUBE_MM - CUBE_MM / 2 for n in per_stack])
    side = max(2, round(size.n_pixels**0.5))
    planes = Planes(
        rotation=rotation,
        center_mm=rotation[:, :, 2] * offset[:, None],
        spacing_mm=np.full((size.n_slices, 2), CUBE_MM / side),
        shape=np.full((size.n_slices, 2), side),
        psf_var_mm2=np.tile(psf_variance_mm2(np.full(2, PIXEL_MM), THICKNESS_MM), (size.n_slices, 1)),
    )
    value = render(cloud, planes).numpy()
    value = value + 0.02 * rng.standard_normal(len(value)).astype(np.float32) * value.mean()
    return _slices(planes, value.astype(np.float32), stack_id, THICKNESS_MM)


def corners(planes: Planes) -> Planes:
    """The same rectangles with a pixel in each corner only: the same overlaps, but hardly any pixels."""
    return replace(planes, shape=np.full((len(planes), 2), 2), spacing_mm=(planes.shape - 1) * planes.spacing_mm)


def corner_slices(slices: Slices) -> Slices:
    """Slices with four pixels each; see `corners`."""
    n = 4 * len(slices)
    return replace(slices, planes=corners(slices.planes), value=np.ones(n, np.float32), mask=np.ones(n, bool))


def made_volume_planes(size: SceneSize) -> Planes:
    """The planes of a volume of the cube."""
    side = max(2, round(size.n_voxels ** (1 / 3)))
    spacing = CUBE_MM / side
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = -spacing * (side - 1) / 2
    return volume_planes(VolumeGrid((side, side, side), affine))


def evaluations(cloud: GaussianCloud, planes: Planes, cutoff_sigma: float) -> tuple[int, int]:
    """The work of rendering: (Gaussian, pixel) evaluations inside the cut-off, and (Gaussian, plane) pairs with any.

    Args:
        cloud: N Gaussians.
        planes: K planes.
        cutoff_sigma: where a Gaussian ends.
    """
    overlaps = find_overlaps(cloud, planes, cutoff_sigma)
    described = PlaneArrays.of(planes, cloud.origin_mm)
    space = np.zeros(overlaps.most, PROJECTION)
    n_pixels, n_pairs = _count(CloudArrays.of(cloud).shapes, described, overlaps.arrays, cutoff_sigma**2, space)
    return int(n_pixels), int(n_pairs)


@numba.njit(nogil=True, cache=True)
def _count(shapes, planes, overlaps, cut, projections):
    n_pixels, n_pairs = 0, 0
    for k in range(len(planes.rotation)):
        n_x, n_y = planes.shape[k, 0], planes.shape[k, 1]
        n = project(shapes, planes, overlaps, k, cut, True, projections)
        n_pairs += n
        for i in range(n):
            p = projections[i]
            for x in range(max(0, int(p.row - p.half_x)), min(n_x, int(p.row + p.half_x) + 3)):
                dx = x - p.row - p.x
                for y in range(max(0, int(p.column - p.half_y)), min(n_y, int(p.column + p.half_y) + 3)):
                    u = y - p.column - p.y - p.slope * dx
                    n_pixels += p.e_0 + p.q_x * dx * dx + p.q_u * u * u >= -0.5 * cut
    return n_pixels, n_pairs


def _cloud(*arrays: NDArray[np.float64]) -> GaussianCloud:
    """A cloud around the world's origin from centres, log-scales, quaternions and amplitudes."""
    return GaussianCloud.of([torch.from_numpy(array.astype(np.float32)) for array in arrays], np.zeros(3))


def _slices(planes: Planes, value: NDArray[np.float32], stack_id: NDArray[np.int64], thickness_mm: float) -> Slices:
    """Slices from planes with pixels, unmasked, numbered in each stack."""
    k = len(planes)
    index = np.arange(k) - np.searchsorted(stack_id, stack_id)
    thickness = np.full(k, thickness_mm)
    return Slices(
        planes=planes,
        value=value,
        mask=np.ones(len(value), bool),
        stack_id=stack_id,
        slice_index=index,
        thickness_mm=thickness,
        header_pose=planes.pose,
    )
