"""Stack-to-stack registration, and self-consistency of a stack."""

import numpy as np
import pytest

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from data_synth.simulator import SimulatedStack
from g3r.geometry import RigidPose
from g3r.registration.stack_registration import register_stacks, self_consistency
from tests.registration.moving_heads import as_slices, pixel_errors_mm, simulated


@pytest.mark.parametrize("seed", [0, 1])
def test_stacks_come_together_from_15_degrees_and_5_mm(still: list[SimulatedStack], seed: int) -> None:
    slices, truth = as_slices(still)
    rng = np.random.default_rng(seed)
    axis, direction = rng.normal(size=(2, 3))
    motion = RigidPose.from_rotvec(
        [np.deg2rad(15) * axis / np.linalg.norm(axis)], [5 * direction / np.linalg.norm(direction)]
    )
    moving = slices.stack_id == 1
    moved = slices.planes.moved(motion)
    slices = slices.with_pose(
        RigidPose(
            np.where(moving[:, None, None], moved.rotation, slices.planes.rotation),
            np.where(moving[:, None], moved.center_mm, slices.planes.center_mm),
        )
    )
    before = pixel_errors_mm(slices, truth).mean()
    registered = register_stacks(slices)
    after = pixel_errors_mm(registered, truth).mean()
    assert before > 1.5
    assert after < 1.0


def test_one_stack_is_left_where_it_is(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still[:1])
    assert register_stacks(slices) is slices


def test_self_consistency_is_lower_with_motion(head: Phantom, still: list[SimulatedStack]) -> None:
    moving, _ = as_slices(simulated(head, MotionLevel(walk_deg=3.0, walk_mm=2.0)))
    lying, _ = as_slices(still)
    for stack in range(3):
        assert self_consistency(lying.take(lying.stack_id == stack)) > self_consistency(
            moving.take(moving.stack_id == stack)
        )
