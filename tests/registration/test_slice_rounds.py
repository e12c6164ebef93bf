"""Rounds of volume and slices: slices in place stay there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from data_synth.simulator import SimulatedStack
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.registration import RegistrationSettings, slice_rounds
from g3r.registration.slice_rounds import CARRIED_ON_MM, carried_on, continued_outwards, fitted_in_place, refine_slices
from tests.registration.moving_heads import as_slices, off_mm, pixel_errors_mm, slices_disturbed


def test_slices_in_place_stay_there(still: list[SimulatedStack]) -> None:
    slices, truth = as_slices(still)
    found = refine_slices(slices, RegistrationSettings(n_rounds=7, finest_voxel_mm=1.8)).slices
    # it was 0.67 mm when the volume ended at the masks and most rounds were coarse
    assert np.median(pixel_errors_mm(found, truth)) < 0.45


def test_longer_moves_end_nearer(still: list[SimulatedStack], monkeypatch: pytest.MonkeyPatch) -> None:
    slices, truth = as_slices(still)
    disturbed, settings = slices_disturbed(slices, 3.0, 1.0), RegistrationSettings(n_rounds=6, finest_voxel_mm=1.8)
    longer = np.median(pixel_errors_mm(refine_slices(disturbed, settings).slices, truth))
    monkeypatch.setattr(slice_rounds, "OVER_RELAXATION", 1.0)
    assert longer < 0.85 * np.median(pixel_errors_mm(refine_slices(disturbed, settings).slices, truth))


def test_slices_are_carried_on_the_way_they_went(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    shift = np.zeros((len(slices), 3))
    shift[:, 0] = 0.5
    shift[3, 0] = 1.1 * CARRIED_ON_MM
    pose = slices.planes.pose
    moved = slices.with_pose(replace(pose, translation_mm=pose.translation_mm + shift))
    assert np.allclose(off_mm(carried_on(slices, moved, 1.0), slices), np.abs(shift[:, 0]))
    went = off_mm(carried_on(slices, moved, 1.8), slices)
    assert went[3] == pytest.approx(1.1 * CARRIED_ON_MM)
    assert np.allclose(np.delete(went, 3), 0.9)
    turned = slices_disturbed(slices, 0.3, 0.0)
    twice = carried_on(slices, turned, 2.0).planes.pose
    assert np.allclose((pose.inverse() @ twice).rotvec_rad(), 2 * (pose.inverse() @ turned.planes.pose).rotvec_rad())


def test_a_slice_without_signal_counts_for_nothing(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    black = int(np.flatnonzero(slices.stack_id == 1)[np.count_nonzero(slices.stack_id == 1) // 2])
    value = np.where(slices.planes.plane_id() == black, 0, slices.value).astype(np.float32)
    found = refine_slices(replace(slices, value=value), RegistrationSettings(n_rounds=3, finest_voxel_mm=1.8))
    assert found.gain[black] < 0.3 * np.median(found.gain)
    assert found.weight[black] < 0.2  # the gain falls from 1, round by round
    assert np.median(np.delete(found.weight, black)) == 1.0


@pytest.mark.parametrize("signal", [0.45, 2.5])
def test_the_gain_of_a_slice_that_stays_is_what_it_is(still: list[SimulatedStack], signal: float) -> None:
    slices, truth = as_slices(still)
    slices = slices.with_motion(truth)
    odd = int(np.flatnonzero(slices.stack_id == 1)[np.count_nonzero(slices.stack_id == 1) // 2])
    factor = np.where(slices.planes.plane_id() == odd, signal, 1.0).astype(np.float32)
    found = fitted_in_place(replace(slices, value=slices.value * factor), RegistrationSettings(finest_voxel_mm=1.8))
    usual = np.median(np.delete(found.gain, odd))
    assert found.gain[odd] / usual == pytest.approx(signal, rel=0.08)


@pytest.mark.parametrize("value", [1.0, -3.0, 0.0])
def test_a_volume_goes_on_beyond_the_masks_as_it_is_at_their_rim(still: list[SimulatedStack], value: float) -> None:
    slices, _ = as_slices(still)
    grid = grid_around(slices, 3.0)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    pixels, weight = (np.full(len(slices.pixel_index), x, np.float32) for x in (value, 1.0))
    volume = continued_outwards(operator, pixels, weight)
    reached = operator.adjoint(weight) > 0
    near = binary_dilation(reached, iterations=4) & ~reached
    assert near.sum() > 0.2 * reached.sum()
    assert np.allclose(volume[reached | near], value, atol=1e-4)


def test_nothing_seen_gives_zeros_without_a_warning(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    operator = VoxelOperator(slices.planes, grid_around(slices, 3.0), slices.pixel_index)
    nothing = np.zeros(len(slices.pixel_index), np.float32)
    assert not continued_outwards(operator, nothing, nothing).any()
