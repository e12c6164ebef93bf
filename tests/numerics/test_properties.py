"""Random scenes of Gaussians and planes against the reference, and the algebra of poses (hypothesis)."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import find_overlaps, render, solve_amplitudes
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid
from tests.numerics.errors import shape_tolerance
from tests.numerics.fast_backends import BACKENDS
from tests.numerics.scenes import Scene, cloud_of, single
from tests.tally import Tally

QUICK = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Scene, float]:
    """A random scene, and its largest axis ratio."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, n_planes = draw(st.integers(0, 12)), draw(st.integers(1, 4))
    low = draw(st.floats(-3.9, 4.6))  # ln mm: 0.02 to 100
    high = min(4.6, low + draw(st.floats(0, 6.9)))  # to a ratio of 1000
    far = draw(st.sampled_from([0.0, 1.0, 1e4]))
    origin = rng.normal(size=3) * far
    spread = np.exp(draw(st.floats(-2, 4)))
    sigma = np.exp(rng.uniform(low, high, (n, 3)))
    cloud = cloud_of(rng.normal(0, spread, (n, 3)), sigma, rng.normal(size=(n, 4)), rng.normal(size=n), origin)
    spacing = np.exp(rng.uniform(np.log(0.3), np.log(3), (n_planes, 2)))
    thickness = np.exp(rng.uniform(np.log(0.1), np.log(20), n_planes))
    psf = psf_variance_mm2(spacing, thickness) * draw(st.sampled_from([0.0, 1.0]))
    planes = Planes(
        rotation=Rotation.random(n_planes, rng=rng).as_matrix(),
        center_mm=origin + rng.normal(0, spread, (n_planes, 3)),
        spacing_mm=spacing,
        shape=rng.integers(1, 40, (n_planes, 2)),
        psf_var_mm2=psf,
    )
    ratio = float((sigma.max(1) / sigma.min(1)).max()) if n else 1.0
    return Scene(cloud, planes), ratio


@given(scenes(), st.sampled_from(["numba", "objective", "amplitudes", "reference32"]))
@QUICK
def test_random_scenes_agree_with_the_reference(
    tally: Tally, scene_and_ratio: tuple[Scene, float], backend: str
) -> None:
    scene, ratio = scene_and_ratio
    weight = torch.tensor(np.random.default_rng(0).normal(size=scene.planes.n_pixels))
    expected, exact_gradient = BACKENDS["reference64"](scene.cloud, scene.planes, weight)
    height = float(scene.cloud.amplitude.abs().sum())
    with tally.case():
        found, gradient = BACKENDS[backend](scene.cloud, scene.planes, weight)
        if len(found):
            assert float((found - expected).abs().max()) <= shape_tolerance(ratio) * height + 2e-8 * height
        for name, g in gradient.items():
            assert torch.isfinite(g).all(), name
        # the gradient in an amplitude is the product of one Gaussian's image with the weights, bounded by their sum
        total = float(weight.abs().sum())
        error = (gradient["amplitude"] - exact_gradient["amplitude"]).abs().max() if len(scene.cloud) else 0.0
        assert float(error) <= (shape_tolerance(ratio) + 2e-8) * total


@given(scenes(), st.floats(-3, 3), st.integers(0, 2**32 - 1))
@QUICK
def test_images_are_linear_in_the_peaks(
    tally: Tally, scene_and_ratio: tuple[Scene, float], factor: float, seed: int
) -> None:
    scene, _ = scene_and_ratio
    cloud = single(scene.cloud)
    other = cloud.with_amplitude(torch.from_numpy(np.random.default_rng(seed).normal(size=len(cloud))).float())
    overlaps = find_overlaps(cloud, scene.planes, 3.2)
    with tally.case():
        first, second, both = (
            render(c, scene.planes, overlaps=overlaps)
            for c in (cloud, other, cloud.with_amplitude(cloud.amplitude + factor * other.amplitude))
        )
        size = float(cloud.amplitude.abs().sum() + abs(factor) * other.amplitude.abs().sum())
        assert float((first + factor * second - both).abs().max()) <= 2e-6 * size


@given(scenes())
@QUICK
def test_least_squares_never_leaves_the_numbers_nor_fits_worse(
    tally: Tally, scene_and_ratio: tuple[Scene, float]
) -> None:
    scene, _ = scene_and_ratio
    cloud = single(scene.cloud)
    target = np.random.default_rng(1).normal(size=scene.planes.n_pixels).astype(np.float32)
    weight = np.ones_like(target)
    with tally.case():
        found = solve_amplitudes(cloud, scene.planes, target, weight, n_iterations=6)
        assert torch.isfinite(found.amplitude).all()
        errors = [float(((render(c, scene.planes).numpy() - target) ** 2).sum()) for c in (cloud, found)]
        assert errors[1] <= errors[0] * (1 + 1e-4)


# -- poses -----------------------------------------------------------------------------------------

ANGLES = st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-8, np.pi])


@st.composite
def poses(draw: st.DrawFn) -> RigidPose:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(1, 5))
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return RigidPose.from_rotvec(axis * draw(ANGLES), rng.normal(size=(n, 3)) * draw(st.sampled_from([0, 1, 1e4])))


def assert_near(a: RigidPose, b: RigidPose, scale_mm: float = 1.0) -> None:
    assert np.abs(a.rotation - b.rotation).max() < 1e-13
    assert np.abs(a.translation_mm - b.translation_mm).max() < 1e-13 * max(1.0, scale_mm)


def size_mm(*all_poses: RigidPose) -> float:
    return 10 * sum(float(np.abs(pose.translation_mm).max()) for pose in all_poses)


@given(poses())
@QUICK
def test_a_pose_and_its_inverse_are_nothing(tally: Tally, pose: RigidPose) -> None:
    with tally.case():
        nothing = RigidPose.identity(len(pose))
        assert_near(pose @ pose.inverse(), nothing, size_mm(pose))
        assert_near(pose.inverse() @ pose, nothing, size_mm(pose))
        assert_near(pose.inverse().inverse(), pose, size_mm(pose))
        assert_near(nothing @ pose, pose, size_mm(pose))


@given(poses(), poses(), poses(), st.integers(0, 2**32 - 1))
@QUICK
def test_composition_is_associative_and_is_applying_one_after_the_other(
    tally: Tally, a: RigidPose, b: RigidPose, c: RigidPose, seed: int
) -> None:
    a, b, c = (pose.take([0]) for pose in (a, b, c))
    points = np.random.default_rng(seed).normal(0, 100, (1, 7, 3))
    with tally.case():
        scale = size_mm(a, b, c)
        assert_near((a @ b) @ c, a @ (b @ c), scale)
        both = (a @ b).apply(points)
        assert np.abs(both - a.apply(b.apply(points))).max() < 1e-13 * (scale + 1000)
        assert_near((a @ b).inverse(), b.inverse() @ a.inverse(), scale)


@given(poses())
@QUICK
def test_rotation_vectors_come_back(tally: Tally, pose: RigidPose) -> None:
    with tally.case():
        vector = pose.rotvec_rad()
        assert (np.linalg.norm(vector, axis=1) <= np.pi + 1e-12).all()
        again = RigidPose.from_rotvec(vector, pose.translation_mm)
        assert np.abs(again.rotation - pose.rotation).max() < 1e-13
        assert (np.linalg.det(pose.rotation) > 0).all()


@given(poses(), st.integers(0, 2**32 - 1))
@QUICK
def test_the_motion_of_points_is_found_again(tally: Tally, pose: RigidPose, seed: int) -> None:
    pose = pose.take([0])
    points = np.random.default_rng(seed).normal(0, 40, (30, 3))
    with tally.case():
        found = fit_rigid(points, pose.apply(points[None])[0])
        assert np.abs(found.rotation - pose.rotation).max() < 1e-11
        assert np.abs(found.apply(points[None]) - pose.apply(points[None])).max() < 1e-9


@given(st.integers(0, 2**32 - 1), st.integers(1, 300))
@QUICK
def test_long_chains_stay_rotations(tally: Tally, seed: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    with tally.case():
        pose = RigidPose.identity(1)
        for _ in range(length):
            pose = RigidPose.from_rotvec(rng.normal(size=(1, 3)), rng.normal(size=(1, 3))) @ pose
        assert np.abs(pose.rotation @ pose.rotation.transpose(0, 2, 1) - np.eye(3)).max() < 1e-14


@given(st.sampled_from(["scale", "shear", "mirror", "nan", "shape"]), st.floats(1e-4, 10))
@QUICK
def test_what_is_no_pose_is_refused(tally: Tally, kind: str, size: float) -> None:
    rotation = np.eye(3)[None].copy()
    if kind == "scale":
        rotation *= 1 + size
    elif kind == "shear":
        rotation[0, 0, 1] = size
    elif kind == "mirror":
        rotation[0, 2, 2] = -1
    elif kind == "nan":
        rotation[0, 0, 0] = np.nan
    else:
        rotation = rotation[0]
    with tally.refusal():
        RigidPose(rotation, np.zeros((1, 3)))
