"""Clouds, planes and slices for the tests."""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud, render

FRAMES = np.stack(
    [
        np.eye(3),
        Rotation.from_euler("x", 90, degrees=True).as_matrix(),
        Rotation.from_euler("y", 90, degrees=True).as_matrix(),
    ]
)
"""Rotations of three orthogonal stacks."""


def cloud_of(
    mean: ArrayLike,
    log_scale: ArrayLike,
    quaternion: ArrayLike,
    amplitude: ArrayLike,
    origin: ArrayLike = (0.0, 0, 0),
    dtype: type[np.floating] = np.float32,
) -> GaussianCloud:
    """A cloud from arrays."""
    arrays = (mean, log_scale, quaternion, amplitude)
    return GaussianCloud.of([torch.from_numpy(np.array(array, dtype)) for array in arrays], np.array(origin))


def make_cloud(
    seed: int,
    n: int,
    sigma: tuple[float, float] = (0.8, 2.0),
    spread_mm: float = 2.5,
    origin: ArrayLike = (40.0, -30.0, 20.0),
) -> GaussianCloud:
    """Random Gaussians around an origin, float64."""
    rng = np.random.default_rng(seed)
    return cloud_of(
        rng.normal(0, spread_mm, (n, 3)),
        np.log(rng.uniform(*sigma, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.uniform(-0.4, 1.0, n),
        origin,
        np.float64,
    )


def make_planes(
    seed: int, n: int = 3, shape: tuple[int, int] = (7, 6), psf: float = 1.0, origin: ArrayLike = (40.0, -30.0, 20.0)
) -> Planes:
    """Random planes near an origin; `psf` scales the variances."""
    rng = np.random.default_rng(seed)
    spacing = rng.uniform(0.7, 1.1, (n, 2))
    return Planes(
        rotation=Rotation.random(n, rng=rng).as_matrix(),
        center_mm=np.array(origin) + rng.normal(0, 1, (n, 3)),
        spacing_mm=spacing,
        shape=np.tile(shape, (n, 1)),
        psf_var_mm2=psf * psf_variance_mm2(spacing, rng.uniform(2, 4, n)),
    )


def stack_planes(n: int, spacing_mm: float, side: int, origin: ArrayLike = (0.0, 0, 0)) -> Planes:
    """Three orthogonal stacks of n gapless planes about an origin, pixels of 1 mm."""
    rotation = np.repeat(FRAMES, n, axis=0)
    offset = np.tile((np.arange(n) - (n - 1) / 2) * spacing_mm, 3)
    pixel = np.full((3 * n, 2), 1.0)
    variance = psf_variance_mm2(pixel, np.full(3 * n, spacing_mm))
    center = np.array(origin) + rotation[:, :, 2] * offset[:, None]
    return Planes(
        rotation=rotation, center_mm=center, spacing_mm=pixel, shape=np.full((3 * n, 2), side), psf_var_mm2=variance
    )


def slices_of(planes: Planes, value: np.ndarray, mask: np.ndarray, n_stacks: int, thickness_mm: float) -> Slices:
    """Planes with pixel values as slices of stacks of equal length."""
    n = len(planes) // n_stacks
    stack_id, index = np.repeat(np.arange(n_stacks), n), np.tile(np.arange(n), n_stacks)
    return Slices(
        planes=planes,
        value=value,
        mask=mask,
        stack_id=stack_id,
        slice_index=index,
        thickness_mm=np.full(len(planes), thickness_mm),
        header_pose=planes.pose,
    )


def single(cloud: GaussianCloud) -> GaussianCloud:
    """The cloud in float32."""
    return GaussianCloud.of([p.float() for p in cloud.parameters], cloud.origin_mm)


def images(cloud: GaussianCloud, planes: Planes) -> Iterator[tuple[np.ndarray, float]]:
    """Pixels of each backend and the tolerance that its arithmetic allows."""
    yield render(cloud, planes, backend="reference").numpy(), 1e-12
    yield render(single(cloud), planes, cutoff_sigma=6.0).numpy(), 3e-6


def assert_same_images(a: tuple[GaussianCloud, Planes], b: tuple[GaussianCloud, Planes]) -> None:
    for (first, tolerance), (second, _) in zip(images(*a), images(*b), strict=True):
        assert np.abs(first - second).max() < tolerance * max(1.0, np.abs(first).max())
