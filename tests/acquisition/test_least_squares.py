"""V_sharp: closer to the head than V_coarse, converging to the direct solution, and its convention."""

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.atlas import TruthVolume
from data_synth.heads import PhantomSubject, load_volume_of
from data_synth.phantom import fetal_brain_phantom
from data_synth.simulator import orthogonal_settings, simulate_stacks
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.least_squares import SHARP_CONVENTION, sharpened_volume, solve_volume
from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid
from tests.registration.moving_heads import as_slices, simulated


@pytest.fixture(scope="module")
def head() -> TruthVolume:
    return load_volume_of(PhantomSubject("26w", 26.0, 3), 1.2)


@pytest.fixture(scope="module", params=[1, 3])
def slices(request: pytest.FixtureRequest, head: TruthVolume) -> Slices:
    settings = orthogonal_settings(
        request.param, resolution_mm=1.2, thickness_mm=3.0, snr=40.0, bias=0.0, gain_deviation=0.0
    )
    stacks = simulate_stacks(head.data, head.mask, head.affine, settings, np.random.default_rng(0))
    return slices_from_stacks([one.stack for one in stacks])


def test_v_sharp_is_nearer_to_the_head(head: TruthVolume, slices: Slices) -> None:
    grid = VolumeGrid(head.data.shape, head.affine)
    coarse, _ = coarse_and_density(slices, grid)
    sharp = sharpened_volume(slices, grid, coarse)
    error = {
        name: float(np.sqrt(((volume - head.data)[head.mask] ** 2).mean()))
        for name, volume in (("coarse", coarse), ("sharp", sharp))
    }
    assert error["sharp"] < 0.9 * error["coarse"]


def test_gain_and_weight_count(head: TruthVolume, slices: Slices) -> None:
    grid = VolumeGrid(head.data.shape, head.affine)
    coarse, _ = coarse_and_density(slices, grid)
    plain = sharpened_volume(slices, grid, coarse)
    brighter = sharpened_volume(slices, grid, 7 * coarse, np.full(len(slices), 1 / 7))
    np.testing.assert_allclose(brighter, 7 * plain, atol=7e-4)
    dark = slices.scaled(1.0)
    dark.value[dark.pixel_index[dark.pixel_plane == 10]] = 0
    slice_weight = np.where(dark.pixel_plane == 10, 0.0, 1.0)
    coarse_without, _ = coarse_and_density(dark, grid, weight=slice_weight)
    without = sharpened_volume(dark, grid, coarse_without, weight=slice_weight)
    accepted = sharpened_volume(dark, grid, coarse_and_density(dark, grid)[0])
    assert np.abs(without - plain).mean() < 0.5 * np.abs(accepted - plain).mean()


def small_problem() -> tuple[VoxelOperator, np.ndarray, np.ndarray]:
    """Every third pixel of four oblique slices with noise and weights, and a grid of 5 x 4 x 6 voxels."""
    rng = np.random.default_rng(2)
    grid = VolumeGrid.isotropic([-4, -3, -5], [4, 3, 5], 2.0)
    planes = Planes(
        rotation=Rotation.from_rotvec(rng.normal(0, 0.6, (4, 3))).as_matrix(),
        center_mm=rng.normal(0, 1.0, (4, 3)),
        spacing_mm=np.tile([1.4, 1.2], (4, 1)),
        shape=np.full((4, 2), 7),
        psf_var_mm2=np.tile([0.4, 0.4, 1.1], (4, 1)),
    )
    index = np.arange(0, planes.n_pixels, 3)
    return VoxelOperator(planes, grid, index), *rng.uniform(0.2, 1, (2, len(index))).astype("f4")


def test_many_steps_find_the_direct_solution() -> None:
    """The direct solution solves the same normal equations, built column by column, in float64."""
    operator, value, weight = small_problem()
    n = int(np.prod(operator.grid.shape))
    unit = np.eye(n, dtype=np.float32).reshape(n, *operator.grid.shape)
    matrix = np.stack([operator.forward(one).astype(float) for one in unit], 1)
    differences = np.concatenate([np.diff(unit, axis=axis).reshape(n, -1).T for axis in (1, 2, 3)]).astype(float)
    seen = matrix.T @ weight
    strength = 0.3 * seen[seen > 0.1 * seen.max()].mean()
    normal = matrix.T @ (weight[:, None] * matrix) + strength * differences.T @ differences
    expected = np.linalg.solve(normal, matrix.T @ (weight * value)).reshape(operator.grid.shape)
    found = solve_volume(operator, value, weight, n_iterations=80, smoothness=0.3)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_two_threads_find_what_one_finds() -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:  # type: ignore[attr-defined]
        pytest.skip("needs two threads")
    problem, before = small_problem(), numba.get_num_threads()
    try:
        found = []
        for n_threads in (1, 2):
            numba.set_num_threads(n_threads)
            found.append(solve_volume(*problem, smoothness=0.02, n_iterations=6))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)


def test_nothing_measured_leaves_the_start_as_it_is() -> None:
    operator, value, weight = small_problem()
    flat = np.full(operator.grid.shape, 0.7, np.float32)
    np.testing.assert_array_equal(solve_volume(operator, value, 0 * weight, smoothness=0.02, start=flat), flat)


def test_the_convention_names_what_it_depends_on() -> None:
    assert SHARP_CONVENTION == "cg6-smoothness0.1-v1"


def test_a_volume_explains_its_slices_and_more_steps_explain_more() -> None:
    slices, _ = as_slices(simulated(fetal_brain_phantom(24, 1.2)))
    grid = grid_around(slices, 1.5)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    weight = np.ones(len(slices.pixel_index), np.float32)
    errors = []
    for n in (1, 4, 16):
        volume = solve_volume(operator, slices.masked_value, weight, smoothness=0.02, n_iterations=n)
        errors.append(float(np.square(operator.forward(volume) - slices.masked_value).mean() ** 0.5))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.05
    again = solve_volume(operator, slices.masked_value, weight, smoothness=0.02, start=volume, n_iterations=2)
    assert np.abs(again - volume).max() < 0.2
