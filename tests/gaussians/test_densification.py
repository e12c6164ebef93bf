"""Extrema of a residual as Gaussians; pruning and merging."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.densification import (
    FIRST_SHARE,
    concatenated,
    exceeds_density,
    find_extrema,
    local_rms,
    pruned,
    with_duplicates_merged,
)
from g3r.geometry import VolumeGrid
from g3r.geometry.quaternion import rotation_from_quaternion
from tests.gaussians.scenes import cloud_of

AFFINE = np.eye(4)
AFFINE[:3, :3] = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix() * [-0.8, 0.8, 0.8]
AFFINE[:3, 3] = [120, -40, 60]
GRID = VolumeGrid((40, 42, 38), AFFINE)
ALL = np.ones(GRID.shape, bool)


def gaussians(
    mean: ArrayLike, sigma: ArrayLike, amplitude: ArrayLike, rotation: Rotation | None = None
) -> GaussianCloud:
    mean = np.atleast_2d(np.asarray(mean, float))
    n = len(mean)
    rotation = Rotation.identity(n) if rotation is None else rotation
    log_scale = np.log(np.broadcast_to(sigma, (n, 3)))
    return cloud_of(mean, log_scale, rotation.as_quat()[:, [3, 0, 1, 2]], amplitude, GRID.center_mm)


def shown(cloud: GaussianCloud) -> np.ndarray:
    return volume_from_pixels(render(cloud, volume_planes(GRID), cutoff_sigma=6.0).numpy(), GRID)


@pytest.mark.parametrize("amplitude", [0.6, -0.3])
def test_an_extremum_is_found_with_its_place_shape_and_height(amplitude: float) -> None:
    turn = Rotation.from_rotvec([[0.4, -0.7, 0.2]])
    true = gaussians([[1.1, -2.0, 0.5]], [2.6, 1.8, 1.1], [amplitude], turn)
    extrema = find_extrema(shown(true), ALL, GRID, 1.2, 0.5)
    best = extrema.take(np.array([np.argmax(extrema.gain)]))
    found = best.cloud(GRID, GRID.center_mm)
    assert np.linalg.norm((found.mean_mm - true.mean_mm).numpy()) < 0.8
    np.testing.assert_allclose(np.sort(best.sigma_mm[0]), [1.1, 1.8, 2.6], rtol=0.2)
    assert float(found.amplitude[0]) == pytest.approx(FIRST_SHARE * amplitude, rel=0.2)
    thin = rotation_from_quaternion(found.quaternion_wxyz)[0][:, int(found.log_scale[0].argmin())]
    assert abs(float(thin @ torch.from_numpy(turn.as_matrix()[0][:, 2]).float())) > 0.95


def test_a_residual_of_zero_has_no_extrema() -> None:
    extrema = find_extrema(np.zeros(GRID.shape, np.float32), ALL, GRID, 1.2, 0.5)
    assert len(extrema) == 0
    assert len(extrema.cloud(GRID, GRID.center_mm)) == 0


def test_local_rms_of_a_constant_is_the_constant_and_zero_outside() -> None:
    mask = ALL.copy()
    mask[:10] = False
    rms = local_rms(np.where(mask, -0.2, 5.0).astype(np.float32), mask, GRID, 1.5)
    np.testing.assert_allclose(rms[mask], 0.2, rtol=1e-3)
    assert not rms[~mask].any()


def test_density_is_exceeded_at_their_own_spacing_and_not_at_half_of_it() -> None:
    axis = np.arange(-12, 12.1, 2.0)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    lattice = gaussians(points, 1.2, np.ones(len(points)))
    asked = GRID.center_mm + np.random.default_rng(0).uniform(-6, 6, (50, 3))
    assert exceeds_density(lattice, asked, 2.4).all()
    assert not exceeds_density(lattice, asked, 1.0).any()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), tolerance=st.floats(1e-4, 3.0))
def test_a_dropped_or_merged_gaussian_changes_the_volume_by_less_than_the_tolerance(
    seed: int, tolerance: float
) -> None:
    """The integral of the squared change, as the voxels see it, for one Gaussian and for one pair."""
    rng = np.random.default_rng(seed)
    one = gaussians(rng.uniform(-3, 3, (1, 3)), rng.uniform(1.0, 2.2, (1, 3)), rng.uniform(0.02, 0.5, 1))
    near = gaussians(
        one.mean_mm.numpy() + rng.uniform(-1, 1, (1, 3)),
        rng.uniform(1.0, 2.2, (1, 3)),
        rng.uniform(0.02, 0.5, 1),
        Rotation.random(1, rng=rng),
    )
    pair = concatenated(one, near)
    for cloud, fewer in ((one, pruned(one, tolerance)), (pair, with_duplicates_merged(pair, tolerance))):
        change = float(((shown(cloud) - shown(fewer)) ** 2).sum()) * GRID.voxel_volume_mm3
        assert change < 1.02 * tolerance + 1e-6
        if len(fewer) == len(cloud):
            torch.testing.assert_close(fewer.amplitude, cloud.amplitude)


def test_duplicates_become_one_and_opposites_stay() -> None:
    duplicates = gaussians([[0.0, 0, 0], [0.3, 0, 0]], 1.5, [0.4, 0.2])
    merged = with_duplicates_merged(duplicates, 0.05)
    assert len(merged) == 1
    assert float(merged.mean_mm[0, 0]) == pytest.approx(0.1, abs=1e-5)
    assert np.abs(shown(duplicates) - shown(merged)).max() < 0.01
    opposite = gaussians([[0.0, 0, 0], [0.3, 0, 0]], 1.5, [0.4, -0.2])
    assert len(with_duplicates_merged(opposite, 0.05)) == 2


def test_clouds_of_none_or_one_pass_through() -> None:
    one = gaussians([[0, 0, 0]], 1.5, [1.0])
    none = one.take(torch.zeros(1, dtype=torch.bool))
    assert len(with_duplicates_merged(one, 1.0)) == 1
    assert len(with_duplicates_merged(none, 1.0)) == len(pruned(none, 1.0)) == 0
    assert len(pruned(one, 1e9)) == 0
