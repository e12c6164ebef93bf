"""Motions in LPS move the same points as in RAS."""

from __future__ import annotations

import numpy as np

from g3r.geometry import RigidPose
from g3r.geometry.lps import LPS_FROM_RAS, in_lps


def test_a_motion_in_lps_moves_the_same_points(rng: np.random.Generator) -> None:
    pose = RigidPose.from_rotvec([[0.4, -1.1, 0.7]], [[31.0, -12.5, 8.25]])
    points_mm, axes = rng.uniform(-100, 100, (1, 20, 3)), np.array([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(in_lps(pose).apply(points_mm * axes) * axes, pose.apply(points_mm), atol=1e-12)


def test_it_comes_back_to_the_bit() -> None:
    pose = RigidPose.from_rotvec([[0.4, -1.1, 0.7]], [[31.0, -12.5, 8.25]])
    again = in_lps(in_lps(pose))
    np.testing.assert_array_equal(again.rotation, pose.rotation)
    np.testing.assert_array_equal(again.translation_mm, pose.translation_mm)
    np.testing.assert_array_equal(LPS_FROM_RAS @ LPS_FROM_RAS, np.eye(4))
