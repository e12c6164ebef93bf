"""Registration of slices that hardly determine their poses: it ends near its start, with finite numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import slice_weights
from g3r.geometry import RigidPose
from g3r.registration import RegistrationSettings
from g3r.registration.similarity import correlation
from g3r.registration.slice_rounds import refine_slices
from tests.numerics.fits import slices_of_small_head
from tests.tally import Tally

ROUNDS = RegistrationSettings(n_rounds=3, steps_per_round=2, finest_voxel_mm=1.6)


def plain() -> Slices:
    return slices_of_small_head()[0]


def of_value(value: float) -> Slices:
    slices = plain()
    return replace(slices, value=np.full_like(slices.value, value))


def far_away() -> Slices:
    slices = plain()
    pose = RigidPose.from_rotvec([[0.0, 0, 0]], [[1e4, -1e4, 1e4]]) @ slices.planes.pose
    return replace(slices.with_pose(pose), header_pose=pose)


CASES: dict[str, Callable[[], Slices]] = {
    "as they are": plain,
    "10 m away": far_away,
    "constant": lambda: of_value(0.5),
    "zero": lambda: of_value(0.0),
    "negative": lambda: of_value(-1.0),
    "one slice": lambda: plain().take([5]),
    "two slices of one stack": lambda: plain().take([4, 5]),
    "tiny": lambda: plain().scaled(1e-6),
    "large": lambda: plain().scaled(1e6),
}


@pytest.mark.parametrize("name", CASES)
def test_slices_of_any_kind_end_in_finite_poses(name: str, tally: Tally) -> None:
    slices = CASES[name]()
    with tally.case():
        found = refine_slices(slices, ROUNDS)
        for array in (found.gain, found.weight, found.ncc, found.slices.planes.center_mm):
            assert np.isfinite(array).all()
        assert np.isfinite([value for entry in found.history for value in entry.values()]).all()
        moved = np.linalg.norm(found.slices.planes.center_mm - slices.planes.center_mm, axis=1)
        assert np.median(moved) < 5.0  # two steps of at most 2 mm in each of three rounds
        if name in ("as they are", "10 m away"):
            assert np.median(moved) < 1.5


def test_ten_metres_make_no_difference(tally: Tally) -> None:
    with tally.case():
        near, far = refine_slices(plain(), ROUNDS), refine_slices(far_away(), ROUNDS)
        back = far.slices.planes.center_mm - [1e4, -1e4, 1e4]
        assert np.abs(back - near.slices.planes.center_mm).max() < 0.02
        assert np.abs(far.slices.planes.rotation - near.slices.planes.rotation).max() < 2e-3


@pytest.mark.parametrize("loss", [0.0, 1e-30, 1.0, 1e30])
def test_equal_slices_are_trusted_alike(loss: float, tally: Tally) -> None:
    with tally.case():
        assert (slice_weights(np.full(9, loss), np.ones(9), 3) == 1).all()
        one_bad = slice_weights(np.array([loss] * 9 + [loss * 100 + 1e-3]), np.ones(10), 3)
        assert np.isfinite(one_bad).all()
        assert (one_bad > 0).all()
        assert (one_bad[:9] == 1).all()


def test_a_correlation_without_variance_is_zero(tally: Tally) -> None:
    with tally.case():
        y, m = np.full(50, 3.0), np.linspace(0, 1, 50)
        moments = np.array([[50, y.sum(), m.sum(), (y * y).sum(), (m * m).sum(), (y * m).sum()], np.zeros(6)])
        assert (correlation(moments) == 0).all()
