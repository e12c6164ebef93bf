"""What slices of a stack moved by together, and how far it is carried on."""

import numpy as np
import pytest

from data_synth.simulator import SimulatedStack
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration import shared_motion
from g3r.registration.held_out import fine_held_out_correlations
from g3r.registration.shared_motion import carried_on, shared_move
from tests.registration.moving_heads import as_slices


def sheared(slices: Slices, mm: float) -> Slices:
    """The slices of each stack shifted along their rows, by up to `mm` at the ends of the stack."""
    center = slices.planes.center_mm.copy()
    for stack in range(slices.n_stacks):
        rows = np.flatnonzero(slices.stack_id == stack)
        place = slices.slice_index[rows] - slices.slice_index[rows].mean()
        center[rows] += mm * (place / np.abs(place).max())[:, None] * slices.planes.rotation[rows, :, 0]
    return slices.with_pose(RigidPose(slices.planes.rotation, center))


def test_a_shear_is_shared_and_a_stray_slice_is_not(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    after = sheared(slices, 1.0)
    center = after.planes.center_mm.copy()
    stray = int(np.flatnonzero(slices.stack_id == 1)[8])
    center[stray] += [0, 9.0, 0]
    move = shared_move(after.with_pose(RigidPose(after.planes.rotation, center)), slices.planes.pose)
    given = np.einsum("kji,kj->ki", slices.planes.rotation, after.planes.center_mm - slices.planes.center_mm)
    assert np.allclose(move[:, :3], 0, atol=1e-6)
    assert np.allclose(move[:, 3:], given, atol=0.1)


def test_half_a_move_is_carried_on_to_the_truth(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    gain = np.ones(len(slices))
    before, half = sheared(slices, 3.0), sheared(slices, 1.5)
    held_out = float(np.mean(fine_held_out_correlations(half, gain)))
    found = carried_on(half, gain, before.planes.pose, held_out)
    assert 0.6 < found.factor < 1.4
    assert found.held_out > held_out
    away = np.linalg.norm(found.slices.planes.center_mm - slices.planes.center_mm, axis=1)
    assert away.max() < 0.7


def test_a_move_that_went_far_enough_is_left_alone(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    gain = np.ones(len(slices))
    held_out = float(np.mean(fine_held_out_correlations(slices, gain)))
    found = carried_on(slices, gain, sheared(slices, 3.0).planes.pose, held_out)
    assert found.factor < 0.2
    assert found.held_out >= held_out


@pytest.mark.parametrize(
    ("values", "factor"),
    [((0.0, 1.0, 0.0), 1.0), ((1.0, 0.0, -3.0), 0.0), ((0.0, 0.1, 1.0), 2.0), ((1.0, 0.1, 0.5), 0.0), ((0, 0, 0), 0)],
)
def test_the_highest_point_of_a_parabola(values: tuple[float, float, float], factor: float) -> None:
    assert shared_motion._peak(*values) == pytest.approx(factor)
