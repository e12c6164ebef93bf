"""Rigid poses: algebra, rotation vectors, refusals, and the fit to points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid, fit_rigid_robust, orthonormal, right_jacobian, rotation_matrix, skew


def poses(seed: int, n: int) -> RigidPose:
    rng = np.random.default_rng(seed)
    return RigidPose(Rotation.random(n, rng=rng).as_matrix(), rng.normal(0, 50, (n, 3)))


def test_composition_applies_the_right_one_first() -> None:
    a, b = poses(0, 4), poses(1, 4)
    points = np.random.default_rng(2).normal(0, 100, (4, 7, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-11)


def test_a_single_motion_is_broadcast_on_either_side() -> None:
    one, many = poses(3, 1), poses(4, 5)
    points = np.random.default_rng(5).normal(0, 100, (5, 2, 3))
    np.testing.assert_allclose(
        (one @ many).apply(points), one.take(np.zeros(5, int)).apply(many.apply(points)), atol=1e-11
    )
    np.testing.assert_allclose(
        (many @ one).apply(points), many.apply(one.take(np.zeros(5, int)).apply(points)), atol=1e-11
    )


def test_inverse_undoes() -> None:
    pose = poses(6, 8)
    for round_trip in (pose @ pose.inverse(), pose.inverse() @ pose):
        np.testing.assert_allclose(round_trip.rotation, RigidPose.identity(8).rotation, atol=1e-14)
        np.testing.assert_allclose(round_trip.translation_mm, 0, atol=1e-12)


def test_matrices_move_the_same_points_and_come_back_from_a_file() -> None:
    pose = poses(8, 4)
    points = np.random.default_rng(9).normal(0, 100, (4, 3))
    homogeneous = np.column_stack([points, np.ones(4)])
    np.testing.assert_allclose(
        np.einsum("sij,sj->si", pose.matrix, homogeneous)[:, :3], pose.apply(points[:, None])[:, 0], atol=1e-11
    )
    read = RigidPose.from_matrix(pose.matrix.round(9).tolist())  # as run.json has them
    np.testing.assert_allclose(read.matrix, pose.matrix, atol=1e-9)
    np.testing.assert_allclose(
        read.rotation @ read.rotation.transpose(0, 2, 1), RigidPose.identity(4).rotation, atol=1e-14
    )


def test_rotations_stay_orthonormal_over_many_compositions() -> None:
    step = poses(7, 1)
    pose = RigidPose.identity(1)
    for _ in range(500):
        pose = step @ pose
    defect = pose.rotation @ pose.rotation.transpose(0, 2, 1) - np.eye(3)
    assert np.abs(defect).max() < 1e-14


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_rotation_vector_round_trip(angle: float) -> None:
    axis = np.array([[1.0, 0, 0], [0, -1, 0], [0.6, 0, 0.8], [1, 2, -2]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    pose = RigidPose.from_rotvec(angle * axis, np.zeros((4, 3)))
    back = pose.rotvec_rad()
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), angle, atol=1e-14, rtol=1e-9)
    # a rotation by pi has two rotation vectors, so the motions are compared
    np.testing.assert_allclose(rotation_matrix(back), pose.rotation, atol=1e-9)
    if angle < 3:
        np.testing.assert_allclose(back, angle * axis, atol=1e-14, rtol=1e-9)


def test_rotation_matrix_keeps_leading_axes() -> None:
    vectors = np.random.default_rng(8).normal(size=(2, 5, 3))
    assert rotation_matrix(vectors).shape == (2, 5, 3, 3)
    np.testing.assert_array_equal(rotation_matrix(vectors)[1, 3], rotation_matrix(vectors[1, 3]))


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.diag([1.0, 1.0, -1.0])[None], np.zeros((1, 3)), "no proper rotation"),
        (1.001 * np.eye(3)[None], np.zeros((1, 3)), "no proper rotation"),
        (np.zeros((1, 3, 3)), np.zeros((1, 3)), "no proper rotation"),
        (np.full((1, 3, 3), np.nan), np.zeros((1, 3)), "not finite"),
        (np.eye(3)[None], np.array([[0, np.inf, 0]]), "not finite"),
        (np.eye(3), np.zeros((1, 3)), "expected \\[S, 3, 3\\]"),
        (np.eye(3)[None], np.zeros(3), "translation_mm"),
        (np.eye(3)[None], np.zeros((2, 3)), "translation_mm"),
    ],
)
def test_what_is_no_motion_is_refused(rotation: np.ndarray, translation: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RigidPose(rotation, translation)


def test_no_motions_at_all_are_fine() -> None:
    none = RigidPose.identity(0)
    assert len(none @ none.inverse()) == 0


def test_orthonormal_gives_the_nearest_proper_rotation() -> None:
    rng = np.random.default_rng(9)
    rotation = Rotation.random(20, rng=rng).as_matrix()
    found = orthonormal(rotation + rng.normal(0, 1e-3, rotation.shape))
    assert (np.linalg.det(found) > 0).all()
    assert np.abs(found - rotation).max() < 5e-3
    mirrored = orthonormal(rotation @ np.diag([1.0, 1, -1]))
    np.testing.assert_allclose(np.linalg.det(mirrored), 1, atol=1e-12)


def test_fit_rigid_recovers_a_known_motion() -> None:
    rng = np.random.default_rng(10)
    truth, source = poses(11, 1), rng.normal(0, 30, (40, 3))
    found = fit_rigid(source, truth.apply(source[None])[0])
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation_mm, truth.translation_mm, atol=1e-10)


def test_fit_rigid_leaves_out_points_of_weight_zero() -> None:
    rng = np.random.default_rng(12)
    truth, source = poses(13, 1), rng.normal(0, 30, (40, 3))
    target = truth.apply(source[None])[0]
    target[:10] += 100
    weight = np.where(np.arange(40) < 10, 0.0, 2.0)
    found = fit_rigid(source, target, weight)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)


def test_fit_rigid_of_points_in_a_plane_is_no_mirror_image() -> None:
    rng = np.random.default_rng(14)
    truth = poses(15, 1)
    source = np.concatenate([rng.normal(0, 30, (40, 2)), np.zeros((40, 1))], axis=1)
    found = fit_rigid(source, truth.apply(source[None])[0])
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)


def test_fit_rigid_robust_is_not_tilted_by_points_that_went_astray(rng: np.random.Generator) -> None:
    truth = RigidPose.from_rotvec([[0.2, -0.4, 0.3]], [[5.0, -3, 9]])
    source = rng.normal(0, 30, (200, 3))
    target = truth.apply(source[None])[0]
    target[::8] += [40.0, -25, 10]
    found, distance_mm = fit_rigid_robust(source, target, scale_mm=2.0, n_rounds=15)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=2e-3)
    np.testing.assert_allclose(distance_mm, np.linalg.norm(found.apply(source[None])[0] - target, axis=1))
    assert distance_mm[::8].min() > 45
    ignored = np.ones(len(source))
    ignored[::8] = 0
    exact, _ = fit_rigid_robust(source, target, scale_mm=2.0, n_rounds=3, weight=ignored)
    np.testing.assert_allclose(exact.translation_mm, truth.translation_mm, atol=1e-9)


def test_rows_are_replaced_and_records_joined() -> None:
    poses = RigidPose.from_rotvec(np.zeros((4, 3)), np.arange(12.0).reshape(4, 3))
    changed = poses.with_rows(np.array([0, 2]), RigidPose.identity(2))
    np.testing.assert_array_equal(changed.translation_mm[[0, 2]], 0)
    np.testing.assert_array_equal(changed.translation_mm[[1, 3]], poses.translation_mm[[1, 3]])
    joined = RigidPose.concatenated([poses, changed])
    assert len(joined) == 8
    np.testing.assert_array_equal(joined.take(slice(4, None)).translation_mm, changed.translation_mm)


def test_skew_is_the_cross_product() -> None:
    a, b = np.random.default_rng(11).normal(size=(2, 6, 3))
    np.testing.assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.99e-4, 1.01e-4, 1.0, 3.0])
def test_right_jacobian_is_the_derivative_of_the_rotation(angle: float) -> None:
    w, dw = angle * np.array([[0.6, 0, 0.8]]), np.array([[1e-6, -2e-6, 1e-6]])
    moved = RigidPose.from_rotvec(w, np.zeros((1, 3))).inverse() @ RigidPose.from_rotvec(w + dw, np.zeros((1, 3)))
    expected = (right_jacobian(w) @ dw[..., None])[..., 0]
    np.testing.assert_allclose(moved.rotvec_rad(), expected, atol=1e-11)  # second order: 1e-12
