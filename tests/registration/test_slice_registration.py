"""Registration of single slices to a volume."""

from dataclasses import replace

import numpy as np

from data_synth.simulator import SimulatedStack
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.slice_registration import register_slices, try_neighbours
from tests.registration.moving_heads import as_slices, pixel_errors_mm, slices_disturbed


def true_volume(slices: Slices, voxel_mm: float = 1.5) -> tuple[np.ndarray, VolumeGrid]:
    grid = grid_around(slices, voxel_mm)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    weight = np.ones(len(slices.pixel_index), np.float32)
    return solve_volume(operator, slices.masked_value, weight, smoothness=0.02, n_iterations=15), grid


def test_slices_find_back_to_a_volume(still: list[SimulatedStack]) -> None:
    slices, truth = as_slices(still)
    volume, grid = true_volume(slices)
    start = slices_disturbed(slices, 2.0, 1.2)
    gain = np.exp(np.random.default_rng(1).normal(0, 0.1, len(slices)))
    dark = replace(start, value=(start.value * np.repeat(gain, np.diff(start.planes.offset))).astype(np.float32))
    model = SampledSlices(dark, volume, grid)
    found, found_gain, fit = register_slices(model, dark, np.ones(len(slices)), n_steps=15, width=0.08)
    before, after = pixel_errors_mm(start, truth), pixel_errors_mm(found, truth)
    assert np.median(after) < 0.3 * np.median(before)
    assert after.mean() < 0.5 * before.mean()
    big = fit.moments[:, 0] > 100
    ratio = np.log(found_gain / gain)[big]
    assert np.abs(ratio - np.median(ratio)).max() < 0.06
    assert fit.ncc[big].min() > 0.9


def test_registration_never_makes_the_fit_worse(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    volume, grid = true_volume(slices)
    start = slices_disturbed(slices, 6.0, 4.0)
    model = SampledSlices(start, volume, grid)
    ones = np.ones(len(slices))
    before = model.evaluate(start.planes, ones, 0.1).loss
    _, _, fit = register_slices(model, start, ones, n_steps=6, width=0.1)
    assert fit.loss.mean() < before.mean()
    assert np.isfinite(fit.hessian).all()


def test_a_slice_that_lost_its_way_takes_its_neighbours_place(still: list[SimulatedStack]) -> None:
    slices, truth = as_slices(still)
    volume, grid = true_volume(slices)
    lost = int(np.flatnonzero(slices.stack_id == 0)[len(np.flatnonzero(slices.stack_id == 0)) // 2])
    center = slices.planes.center_mm.copy()
    center[lost] += [9.0, -7, 6]
    astray = slices.with_pose(RigidPose(slices.planes.rotation, center))
    model = SampledSlices(astray, volume, grid)
    found, n_moved = try_neighbours(model, astray, np.ones(len(slices)), width=0.1)
    assert n_moved >= 1
    np.testing.assert_allclose(found.planes.center_mm[lost], slices.planes.center_mm[lost], atol=1e-6)
    assert pixel_errors_mm(found, truth).max() < 1.0
