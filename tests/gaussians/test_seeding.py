"""Seeding: positions and number of the Gaussians, and flatness of a constant."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.gaussians import render
from g3r.gaussians.seeding import MAX_ANISOTROPY, SCALE_PER_SPACING, seed_cloud
from g3r.geometry import VolumeGrid
from g3r.geometry.quaternion import rotation_from_quaternion

AFFINE = np.eye(4)
AFFINE[:3, :3] = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix() * [-1.0, 1, 1]
AFFINE[:3, 3] = [120, -40, 60]
GRID = VolumeGrid((40, 42, 38), AFFINE)
INDEX = np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), -1)
BALL = ((INDEX - (np.array(GRID.shape) - 1) / 2) ** 2).sum(-1) < 17**2


def test_seeds_lie_in_the_mask_and_are_as_many_as_asked_for() -> None:
    for spacing in (2.0, 3.0):
        cloud = seed_cloud(np.ones(GRID.shape, np.float32), BALL, GRID, spacing)
        world = cloud.mean_mm.double().numpy() + cloud.origin_mm
        nearest = np.rint(GRID.index(world)).astype(int)
        assert BALL[tuple(nearest.T)].all()
        assert len(cloud) == pytest.approx(BALL.sum() * GRID.voxel_volume_mm3 / spacing**3, rel=0.1)


@pytest.mark.parametrize("spacing", [2.0, 3.0])
def test_a_constant_comes_out_flat(spacing: float) -> None:
    volume = np.full(GRID.shape, 0.7, np.float32)
    cloud = seed_cloud(volume, BALL, GRID, spacing)
    sigma = cloud.log_scale.exp()
    torch.testing.assert_close(sigma, torch.full_like(sigma, SCALE_PER_SPACING * spacing), rtol=1e-5, atol=0)
    found = volume_from_pixels(render(cloud, volume_planes(GRID), cutoff_sigma=6.0).numpy(), GRID)
    middle = ((INDEX - (np.array(GRID.shape) - 1) / 2) ** 2).sum(-1) < (17 - 3 * spacing) ** 2
    assert found[middle].mean() == pytest.approx(0.7, rel=0.02)
    assert np.abs(found[middle] - 0.7).max() < 0.03 * 0.7


def test_seeds_are_flat_across_an_edge() -> None:
    """At a step along the grid's third axis, the axis of the smallest sigma is normal to the step in world axes."""
    volume = (INDEX[..., 2] > 18.5).astype(np.float32)
    cloud = seed_cloud(volume, BALL, GRID, 2.0)
    third = GRID.index(cloud.mean_mm.double().numpy() + cloud.origin_mm)[:, 2]
    edge = np.abs(third - 18.5) < 0.8
    assert edge.sum() > 20
    log_scale = cloud.log_scale[edge].double()
    smallest = log_scale.argmin(1)
    axis = rotation_from_quaternion(cloud.quaternion_wxyz[edge].double())[torch.arange(int(edge.sum())), :, smallest]
    normal = AFFINE[:3, 2]
    assert np.abs(axis.numpy() @ normal).min() > 0.95
    ratio = (log_scale - log_scale.mean(1, keepdim=True)).exp()
    assert ratio.min() < 0.8
    assert ratio.max() < MAX_ANISOTROPY**2
    torch.testing.assert_close(log_scale.mean(1).exp(), torch.full((int(edge.sum()),), 1.2).double(), rtol=1e-4, atol=0)


def test_an_empty_foreground_is_refused() -> None:
    with pytest.raises(ValueError, match="foreground is empty"):
        seed_cloud(np.ones(GRID.shape, np.float32), np.zeros(GRID.shape, bool), GRID, 2.0)


def test_a_foreground_of_one_voxel_is_no_error() -> None:
    mask = np.zeros(GRID.shape, bool)
    mask[20, 20, 20] = True
    cloud = seed_cloud(np.ones(GRID.shape, np.float32), mask, GRID, 2.0)
    assert all(torch.isfinite(p).all() for p in cloud.parameters)
