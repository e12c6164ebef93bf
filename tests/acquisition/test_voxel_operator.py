"""The voxel operator: exact adjoint, exact on ramps, correct on a Gaussian; quadrature of the PSF."""

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, volume_planes
from g3r.acquisition.psf import FWHM_PER_SIGMA, psf_variance_mm2
from g3r.acquisition.voxel_operator import VoxelOperator, psf_nodes
from g3r.geometry import RigidPose, VolumeGrid

OBLIQUE = np.eye(4)
OBLIQUE[:3, :3] = Rotation.from_rotvec([0.4, 0.1, -0.6]).as_matrix() * [1.1, 1.3, 0.9] @ np.diag([1.0, -1, 1])
OBLIQUE[:3, 3] = [-8, 9, -7]
GRID = VolumeGrid((17, 15, 16), OBLIQUE)


def random_planes(seed: int, n: int = 6, spread_mm: float = 6.0, thickness_mm: float = 3.0) -> Planes:
    """Planes through and beside the grid, many of whose pixels lie outside."""
    rng = np.random.default_rng(seed)
    spacing = rng.uniform(0.7, 1.6, (n, 2))
    return Planes(
        rotation=Rotation.random(n, rng=rng).as_matrix(),
        center_mm=GRID.center_mm + rng.normal(0, spread_mm, (n, 3)),
        spacing_mm=spacing,
        shape=rng.integers(8, 20, (n, 2)),
        psf_var_mm2=psf_variance_mm2(spacing, np.full(n, thickness_mm)),
    )


@pytest.mark.parametrize("points", [(1, 1, 1), (1, 1, 5), (3, 3, 7)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_adjoint_is_exact(seed: int, points: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(seed)
    planes = random_planes(seed)
    index = np.flatnonzero(rng.random(planes.n_pixels) < 0.7)
    operator = VoxelOperator(planes, GRID, index, points)
    volume, pixels = rng.normal(size=GRID.shape), rng.normal(size=len(index))
    image, back = operator.forward(volume), operator.adjoint(pixels)
    assert (image == 0).any()  # some pixels see nothing
    assert np.abs(image @ pixels - (volume * back).sum()) <= 1e-12 * np.linalg.norm(image) * np.linalg.norm(pixels)


def test_the_adjoint_is_exact_with_several_buffers() -> None:
    n_threads = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if n_threads < 2:
        pytest.skip("one thread only")
    rng = np.random.default_rng(3)
    planes = random_planes(3)
    operator = VoxelOperator(planes, GRID)
    pixels = rng.normal(size=planes.n_pixels)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = operator.adjoint(pixels)
        numba.set_num_threads(2)
        together = operator.adjoint(pixels)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-13)


@pytest.mark.parametrize("points", [(1, 1, 1), (1, 1, 5), (3, 3, 5)])
def test_a_ramp_is_reproduced(points: tuple[int, int, int]) -> None:
    """Trilinear reading and symmetric nodes are exact for a linear volume, whatever the PSF."""
    grid = VolumeGrid((60, 60, 60), np.array(GRID.affine))
    slope, height = np.array([0.3, -1.2, 0.7]), 5.0
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    volume = grid.world(index) @ slope + height
    planes = random_planes(4, spread_mm=1.0)
    planes = planes.with_pose(RigidPose(planes.rotation, planes.center_mm - GRID.center_mm + grid.center_mm))
    pixels = VoxelOperator(planes, grid, None, points).forward(volume)
    np.testing.assert_allclose(pixels, planes.pixel_world_mm() @ slope + height, rtol=0, atol=1e-11)


def test_a_gaussian_through_the_psf_has_its_closed_form() -> None:
    grid = VolumeGrid.isotropic([-13] * 3, [13] * 3, 0.3)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    mean, sigma = np.array([0.4, -0.7, 0.2]), 2.5
    volume = np.exp(-((grid.world(index) - mean) ** 2).sum(-1) / (2 * sigma**2))
    rng = np.random.default_rng(5)
    spacing = np.tile([0.9, 1.2], (4, 1))
    planes = Planes(
        rotation=Rotation.random(4, rng=rng).as_matrix(),
        center_mm=rng.normal(0, 1.5, (4, 3)),
        spacing_mm=spacing,
        shape=np.full((4, 2), 9),
        psf_var_mm2=psf_variance_mm2(spacing, np.full(4, 3.0)),
    )
    pixels = VoxelOperator(planes, grid, None, (5, 5, 9)).forward(volume)
    expected = []
    for k in range(4):
        variance = sigma**2 + planes.psf_var_mm2[k]
        local = (planes.take([k]).pixel_world_mm() - mean) @ planes.rotation[k]
        expected.append(np.sqrt(sigma**6 / variance.prod()) * np.exp(-0.5 * (local**2 / variance).sum(1)))
    # trilinear interpolation adds h^2/6 of variance on average: 3 h^2 / (12 sigma^2) = 0.4 % of the peak
    assert np.abs(pixels - np.concatenate(expected)).max() < 0.005


def test_planes_of_the_grid_read_its_voxels() -> None:
    volume = np.random.default_rng(6).normal(size=GRID.shape)
    grid = VolumeGrid(GRID.shape, np.diag([1.1, 1.3, 0.9, 1.0]))
    pixels = VoxelOperator(volume_planes(grid), grid, None, (1, 1, 1)).forward(volume)
    np.testing.assert_allclose(pixels, volume.transpose(2, 0, 1).ravel(), atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_is_kept(dtype: type[np.floating]) -> None:
    planes = random_planes(7)
    operator = VoxelOperator(planes, GRID)
    assert operator.forward(np.ones(GRID.shape, dtype)).dtype == dtype
    assert operator.adjoint(np.ones(planes.n_pixels, dtype)).dtype == dtype


def test_move_takes_other_poses() -> None:
    planes, others = random_planes(8), random_planes(9)
    others = planes.with_pose(others.pose)
    volume = np.random.default_rng(8).normal(size=GRID.shape)
    operator = VoxelOperator(planes, GRID)
    operator.move(others)
    np.testing.assert_array_equal(operator.forward(volume), VoxelOperator(others, GRID).forward(volume))


def test_arrays_of_another_size_are_refused() -> None:
    operator = VoxelOperator(random_planes(10), GRID)
    with pytest.raises(ValueError, match="volume has shape"):
        operator.forward(np.zeros((3, 3, 3)))
    with pytest.raises(ValueError, match="pixels have shape"):
        operator.adjoint(np.zeros(3))


def test_a_grid_of_one_voxel_and_no_planes() -> None:
    grid = VolumeGrid((1, 1, 1), np.eye(4))
    planes = random_planes(11)
    operator = VoxelOperator(planes, grid)
    assert np.isfinite(operator.forward(np.ones((1, 1, 1)))).all()
    nothing = VoxelOperator(planes.take([]), grid)
    assert nothing.forward(np.ones((1, 1, 1))).shape == (0,)
    assert (nothing.adjoint(np.zeros(0)) == 0).all()


@pytest.mark.parametrize("n", [1, 2, 3, 5, 7, 15, 31])
def test_psf_nodes_have_the_moments_of_a_gaussian(n: int) -> None:
    nodes, weights = psf_nodes(n)
    assert len(nodes) == len(weights) == n
    assert weights.sum() == pytest.approx(1, abs=1e-14)
    assert (weights * nodes).sum() == pytest.approx(0, abs=1e-15)
    assert (weights * nodes**2).sum() == pytest.approx(0 if n == 1 else 1, abs=1e-14)
    np.testing.assert_allclose(nodes, -nodes[::-1])
    if n >= 7:  # the kurtosis of a Gaussian is 3, and 2.6 if it is cut at 2.6 sigma
        assert 2.2 < (weights * nodes**4).sum() < 3.1


def test_psf_variance_is_that_of_the_source() -> None:
    """FWHM 1.2 pixels in plane and the thickness through it (Kuklisova-Murgasova 2012)."""
    variance = psf_variance_mm2([[0.8, 1.0]], [3.0])
    np.testing.assert_allclose(np.sqrt(variance) * FWHM_PER_SIGMA, [[0.96, 1.2, 3.0]])
    assert pytest.approx(2.3548, abs=1e-4) == FWHM_PER_SIGMA
