"""V_sharp: nearer to the head than V_coarse, and what its convention promises."""

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from data_synth.heads import PhantomSubject, load_volume_of
from data_synth.phantom import fetal_brain_phantom
from data_synth.simulator import orthogonal_settings, simulate_stacks
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.least_squares import SHARP_CONVENTION, sharpened_volume, solve_volume
from g3r.acquisition.planes import Slices
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


def test_the_convention_names_what_it_depends_on() -> None:
    assert SHARP_CONVENTION == "cg6-smoothness0.1-v1"


def test_a_volume_explains_its_slices_and_more_steps_explain_more() -> None:
    slices, _ = as_slices(simulated(fetal_brain_phantom(24, 1.2)))
    grid = grid_around(slices, 1.5)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    weight = np.ones(len(slices.pixel_index), np.float32)
    errors = []
    for n in (1, 4, 16):
        volume = solve_volume(operator, slices.masked_value, weight, n_iterations=n)
        errors.append(float(np.square(operator.forward(volume) - slices.masked_value).mean() ** 0.5))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.05
    again = solve_volume(operator, slices.masked_value, weight, start=volume, n_iterations=2)
    assert np.abs(again - volume).max() < 0.2
