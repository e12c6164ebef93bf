"""Scenes of the numerics suite: Gaussians of extreme shapes, on the most difficult planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud

PIXEL_MM, THICKNESS_MM = 0.8, 2.2
ORIGIN_MM = np.array([40.0, -30.0, 20.0])


@dataclass(frozen=True)
class Scene:
    """A cloud and the planes that see it."""

    cloud: GaussianCloud
    planes: Planes


def single(cloud: GaussianCloud) -> GaussianCloud:
    """The cloud in float32."""
    return GaussianCloud.of([p.float() for p in cloud.parameters], cloud.origin_mm)


def cloud_of(
    mean_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    quaternion_wxyz: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    origin_mm: NDArray[np.float64] = ORIGIN_MM,
) -> GaussianCloud:
    """A float64 cloud with parameters that float32 represents exactly, so that errors come from arithmetic alone."""
    arrays = (mean_mm, np.log(sigma_mm), quaternion_wxyz, amplitude)
    return GaussianCloud.of([torch.tensor(array, dtype=torch.float32).double() for array in arrays], origin_mm)


def slender_scenes(ratio: float, widest_mm: float, psf: bool, n: int = 12, seed: int = 0) -> list[Scene]:
    """Single Gaussians of one axis ratio, each on three planes.

    Two planes nearly contain the longest and the shortest axis, tilted by about the critical angle, with
    pixels of half the shortest sigma along one axis and an eighth of the longest along the other; one plane is random.

    Args:
        ratio: longest over shortest sigma; the third is between them.
        widest_mm: the longest sigma.
        psf: whether the planes have the PSF of slices or no PSF.
        n: number of scenes.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(n):
        sigma = widest_mm * np.array([1.0, 1 / ratio, ratio ** -rng.uniform(0.2, 0.8)])
        turn = Rotation.random(rng=rng)
        cloud = cloud_of(rng.normal(0, 3, (1, 3)), sigma[None], np.roll(turn.as_quat(), 1)[None], np.ones(1))
        seen = np.sqrt(sigma[1] ** 2 + (0.4**2 if psf else 0.0))
        shift = turn.apply(rng.normal(0, 0.7, (2, 3)) * sigma)
        tilted = turn * Rotation.from_rotvec(rng.normal(0, seen / widest_mm, (2, 3)))
        at_random = Rotation.random(rng=rng)
        middle = cloud.origin_mm + cloud.mean_mm[0].numpy()
        spacing = np.array([[widest_mm / 8, seen / 2]] * 2 + [[PIXEL_MM, PIXEL_MM]])
        spacing = np.maximum(spacing, 1e-3)
        variance = psf_variance_mm2([PIXEL_MM, PIXEL_MM], THICKNESS_MM) if psf else np.zeros(3)
        planes = Planes(
            rotation=np.concatenate([tilted.as_matrix(), at_random.as_matrix()[None]]),
            center_mm=np.concatenate([middle + shift, middle[None] + rng.normal(0, 0.3 * sigma.min(), (1, 3))]),
            spacing_mm=spacing,
            shape=np.array([[40, 24]] * 3),
            psf_var_mm2=np.tile(variance, (3, 1)),
        )
        scenes.append(Scene(cloud, planes))
    return scenes


def head_scene(origin_mm: NDArray[np.float64] = ORIGIN_MM, n: int = 60, seed: int = 0) -> Scene:
    """Round and flat Gaussians in a ball of 12 mm, and three stacks of slices through it."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    points *= (11 * rng.random(n) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    cloud = cloud_of(
        points, rng.uniform(1.2, 3.0, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.2, 0.8, n), origin_mm
    )
    return Scene(cloud, stacks_of_planes(origin_mm))


def stacks_of_planes(
    origin_mm: NDArray[np.float64], thickness_mm: float = THICKNESS_MM, n_slices: int = 10, n_pixels: int = 28
) -> Planes:
    """Three crossing stacks of parallel slices with pixels of 0.8 mm."""
    frames = [np.eye(3), *Rotation.from_euler("xy", [[90, 0], [0, 90]], degrees=True).as_matrix()]
    rotation = np.repeat(frames, n_slices, axis=0)
    offset = np.tile((np.arange(n_slices) - (n_slices - 1) / 2) * thickness_mm, 3)
    n = len(rotation)
    spacing = np.full((n, 2), PIXEL_MM)
    return Planes(
        rotation=rotation,
        center_mm=origin_mm + rotation[:, :, 2] * offset[:, None],
        spacing_mm=spacing,
        shape=np.full((n, 2), n_pixels),
        psf_var_mm2=psf_variance_mm2(spacing, np.full(n, thickness_mm)),
    )
