"""Movement of the head between slices: of a still head, in the order of time, and where no order explains it."""

import numpy as np
import pytest

from data_synth.phantom import Phantom
from g3r.geometry import RigidPose
from g3r.registration.head_movement import median_moves_mm, segments_of
from g3r.registration.motion_segments import INTERLEAVES
from g3r.registration.similarity import StackSamples
from tests.registration.moving_heads import Moving, as_slices, simulated

DRIFT_MM = 2.0


def shifted(mm: np.ndarray) -> RigidPose:
    """Motions [K] along x."""
    n = len(mm)
    return RigidPose(np.tile(np.eye(3), (n, 1, 1)), np.stack([mm, np.zeros(n), np.zeros(n)], axis=-1))


@pytest.fixture(scope="module")
def one_stack(head: Phantom) -> StackSamples:
    slices, _ = as_slices(simulated(head, n_stacks=1))
    return StackSamples.of_all(slices)[0]


def test_a_still_head_does_not_move(one_stack: StackSamples) -> None:
    still = RigidPose.identity(len(one_stack.rows))
    assert median_moves_mm([one_stack], still) == [0.0]
    assert segments_of([one_stack], still) == ([1], [None])


@pytest.mark.parametrize("interleave", [1, 2, 5])
def test_a_drift_is_measured_in_the_order_of_time(one_stack: StackSamples, interleave: int) -> None:
    """Next to each other in space, slices of such a stack are many times further apart."""
    number = one_stack.slice_index
    order = np.lexsort((number, number % interleave))
    mm = np.empty(len(number))
    mm[order] = DRIFT_MM * np.arange(len(number))
    assert median_moves_mm([one_stack], shifted(mm)) == [pytest.approx(DRIFT_MM)]
    assert segments_of([one_stack], shifted(mm)) == ([len(number)], [interleave])


def test_what_no_order_explains_stays_large(one_stack: StackSamples) -> None:
    mm = np.random.default_rng(0).uniform(-40, 40, len(one_stack.rows))
    assert max(INTERLEAVES) < len(mm)
    assert median_moves_mm([one_stack], shifted(mm))[0] > 10


def test_the_registration_of_a_moving_head_has_its_moves(moving: Moving) -> None:
    found = moving.estimate.median_move_mm
    assert len(found) == 3
    assert found == pytest.approx(median_moves_mm(StackSamples.of_all(moving.slices), moving.truth), abs=0.7)
