"""Motion of heads during a stack."""

import numpy as np

from data_synth.motion import MotionLevel, slice_trajectory
from g3r.acquisition.interleave import acquisition_order


def test_neighbours_in_time_move_together() -> None:
    level = MotionLevel(walk_mm=1.0, walk_deg=1.0)
    rng = np.random.default_rng(0)
    pose = slice_trajectory(200, level, np.zeros(3), 2, rng)
    in_time = pose.translation_mm[acquisition_order(200, 2)]
    assert 0.8 < np.diff(in_time, axis=0).std() < 1.2
    assert np.abs(in_time.mean(0)).max() < 0.5


def test_a_jerk_lasts() -> None:
    level = MotionLevel(n_jerks=1, jerk_mm=5.0)
    pose = slice_trajectory(30, level, np.zeros(3), 1, np.random.default_rng(1))
    steps = np.linalg.norm(np.diff(pose.translation_mm, axis=0), axis=1)
    assert (steps > 1e-9).sum() == 1


def test_the_head_turns_about_its_centre() -> None:
    center = np.array([30.0, -20.0, 50.0])
    level = MotionLevel(offset_deg=20.0)
    pose = slice_trajectory(8, level, center, 2, np.random.default_rng(2))
    np.testing.assert_allclose(pose.apply(np.tile(center, (8, 1))), np.tile(center, (8, 1)), atol=1e-9)
