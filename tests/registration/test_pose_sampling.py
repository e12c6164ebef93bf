"""Candidate poses: evenly spread rotations, random motions around given ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.geometry import RigidPose
from g3r.registration.pose_sampling import (
    angle_deg,
    distinct,
    perturbed,
    rotations_about,
    rotations_within,
    uniform_rotations,
)

CENTER_MM = np.array([10.0, -20.0, 30.0])


def test_uniform_rotations_are_rotations_that_cover_the_sphere(rng: np.random.Generator) -> None:
    rotation = uniform_rotations(4000)
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    asked = Rotation.random(400, rng=rng).as_matrix()
    nearest = np.array([angle_deg(rotation, one).min() for one in asked])
    assert nearest.max() < 20
    assert np.median(nearest) < 11
    # no two of them are equal
    assert min(np.partition(angle_deg(rotation, one), 1)[1] for one in rotation[::40]) > 5


def test_rotations_within_a_limit_are_the_share_that_the_sphere_has_there() -> None:
    near = rotations_within(20_000, 70.0)
    assert angle_deg(near, np.eye(3)).max() < 70
    limit = np.deg2rad(70)
    assert len(near) / 20_000 == pytest.approx((limit - np.sin(limit)) / np.pi, rel=0.05)


def test_angles_between_rotations() -> None:
    turn = Rotation.from_rotvec(np.deg2rad([[0.0, 0, 0], [0.0, 30, 0], [180.0, 0, 0], [0, 1e-3, 0]])).as_matrix()
    np.testing.assert_allclose(angle_deg(turn, np.eye(3)), [0, 30, 180, 1e-3], atol=1e-5)
    base = Rotation.random(1, rng=np.random.default_rng(3)).as_matrix()[0]
    np.testing.assert_allclose(angle_deg(turn @ base, base), [0, 30, 180, 1e-3], atol=1e-4)


@pytest.mark.parametrize("target", [np.array([1.0, 2, 3]), np.arange(12.0).reshape(4, 3)])
def test_rotations_about_a_point_take_it_to_the_target(target: np.ndarray) -> None:
    motion = rotations_about(uniform_rotations(4), CENTER_MM, target)
    np.testing.assert_allclose(motion.apply(np.tile(CENTER_MM, (4, 1))), np.broadcast_to(target, (4, 3)), atol=1e-12)


def test_perturbed_keeps_what_it_was_given_and_spreads_as_stated(rng: np.random.Generator) -> None:
    given = rotations_about(uniform_rotations(3), CENTER_MM, CENTER_MM + rng.normal(0, 9, (3, 3)))
    found = perturbed(given, CENTER_MM, 2000, 6.0, 2.5, rng)
    assert len(found) == 3 * 2001
    np.testing.assert_array_equal(found.rotation[:3], given.rotation)
    np.testing.assert_array_equal(found.translation_mm[:3], given.translation_mm)
    for k in range(3):  # in blocks, each around its own centre
        block = found.take(np.arange(3 + 2000 * k, 3 + 2000 * (k + 1)))
        turn = Rotation.from_matrix(block.rotation @ given.rotation[k].T).as_rotvec(degrees=True)
        shift = block.apply(np.tile(CENTER_MM, (2000, 1))) - given.apply(np.tile(CENTER_MM, (3, 1)))[k]
        np.testing.assert_allclose(turn.std(0), 6.0, rtol=0.08)
        np.testing.assert_allclose(shift.std(0), 2.5, rtol=0.08)
        assert np.abs(turn.mean(0)).max() < 0.5
        assert np.abs(shift.mean(0)).max() < 0.25


def test_distinct_motions_are_kept_once_in_their_order(rng: np.random.Generator) -> None:
    three = rotations_about(uniform_rotations(3), CENTER_MM, CENTER_MM + rng.normal(0, 9, (3, 3)))
    again = three.take([2, 0, 2, 1, 0, 1, 1])
    found = distinct(again, CENTER_MM)
    np.testing.assert_array_equal(found.translation_mm, three.translation_mm[[2, 0, 1]])
    shifted = RigidPose(three.rotation, three.translation_mm + 0.1)
    both = RigidPose(
        np.concatenate([three.rotation, shifted.rotation]),
        np.concatenate([three.translation_mm, shifted.translation_mm]),
    )
    assert len(distinct(both, CENTER_MM)) == 6
    turned = RigidPose.from_rotvec(np.deg2rad([[0.0, 0, 0], [0, 0, 0.3]]), np.zeros((2, 3)))
    assert len(distinct(turned, np.zeros(3))) == 2
