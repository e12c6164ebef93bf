"""Neighbours of slices: beside each other in space or in time, and what that is worth where the head keeps moving."""

import numpy as np
import pytest

from data_synth.motion import LEVELS
from data_synth.phantom import Phantom
from g3r.acquisition.interleave import acquisition_order
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration import slice_neighbours
from g3r.registration.settings import RegistrationSettings
from g3r.registration.slice_neighbours import OFFSETS, neighbours
from g3r.registration.slice_rounds import refine_slices
from tests.registration.moving_heads import as_slices, pixel_errors_mm, simulated, slices_disturbed

INTERLEAVE = 5


def in_order(number: np.ndarray, interleave: int) -> list[int]:
    """The slice numbers of a stack in the order of their acquisition."""
    return [q for q in acquisition_order(int(number.max()) + 1, interleave).tolist() if q in number]


def drifting(slices: Slices, interleave: int) -> Slices:
    """Slices of a head that drifts steadily while each stack is taken."""
    shift_mm = np.zeros((len(slices), 3))
    for stack in np.unique(slices.stack_id):
        rows = np.flatnonzero(slices.stack_id == stack)
        order = in_order(slices.slice_index[rows], interleave)
        shift_mm[rows, 0] = [3.0 * order.index(q) for q in slices.slice_index[rows]]
    return slices.with_motion(RigidPose(np.tile(np.eye(3), (len(slices), 1, 1)), shift_mm))


@pytest.mark.parametrize(("interleave", "counts"), [(1, 1), (2, 1), (3, 3), (5, 5)])
def test_neighbours_are_in_space_or_in_the_order_of_time(head: Phantom, interleave: int, counts: int) -> None:
    slices = drifting(as_slices(simulated(head))[0], interleave)
    for offset, source in zip(OFFSETS, neighbours(slices), strict=True):
        for row, other in enumerate(source.tolist()):
            own = slices.slice_index[slices.stack_id == slices.stack_id[row]]
            order = in_order(own, counts)
            place = order.index(slices.slice_index[row]) + offset
            alone = not 0 <= place < len(order)
            assert slices.stack_id[other] == slices.stack_id[row]
            assert slices.slice_index[other] == (slices.slice_index[row] if alone else order[place])


def test_a_head_that_keeps_moving_is_kept_in_place_whatever_the_order(
    head: Phantom, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With neighbours in space, slices are drawn to where the head was a pass before."""
    slices, truth = as_slices(simulated(head, LEVELS["severe"], seed=3, interleave=INTERLEAVE))
    start = slices_disturbed(slices.with_motion(truth), 1.0, 0.5)
    settings = RegistrationSettings(n_rounds=6, finest_voxel_mm=1.8, stray_searches=0)

    def off_share() -> float:
        return float((pixel_errors_mm(refine_slices(start, settings).slices, truth) > 2.0).mean())

    in_time = off_share()
    monkeypatch.setattr(slice_neighbours, "IN_SPACE_UP_TO", INTERLEAVE)
    assert in_time < 0.05
    assert off_share() > in_time + 0.1
