"""Gradient and Gauss-Newton matrix of the slice model against finite differences of the voxel operator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import rotation_matrix
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.similarity import correlation

AFFINE = np.eye(4)
AFFINE[:3, :3] = Rotation.from_rotvec([0.4, -0.2, 0.3]).as_matrix() * [1.0, -1.1, 0.9]
AFFINE[:3, 3] = [-20, 25, -20]
GRID = VolumeGrid((44, 40, 46), AFFINE)


def smooth_volume() -> np.ndarray:
    index = np.stack(np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij"), -1)
    x = GRID.world(index) - GRID.center_mm
    wave = np.sin(0.21 * x[..., 0] + 0.1 * x[..., 1]) * np.cos(0.17 * x[..., 2] - 0.08 * x[..., 1])
    return (1 + 0.5 * wave).astype(np.float32)


def make_slices(seed: int = 0, n: int = 4) -> tuple[Slices, np.ndarray]:
    """Planes well inside the grid, with random gains and pixel noise."""
    rng = np.random.default_rng(seed)
    spacing = np.full((n, 2), 1.3)
    planes = Planes(
        rotation=Rotation.random(n, rng=rng).as_matrix(),
        center_mm=GRID.center_mm + rng.normal(0, 1.5, (n, 3)),
        spacing_mm=spacing,
        shape=np.full((n, 2), 9),
        psf_var_mm2=psf_variance_mm2(spacing, np.full(n, 3.0)),
    )
    volume = smooth_volume()
    gain = rng.uniform(0.7, 1.4, n)
    value = VoxelOperator(planes, GRID).forward(volume) * gain[planes.plane_id()]
    value = value + rng.normal(0, 0.05, planes.n_pixels)
    mask = rng.random(planes.n_pixels) < 0.8
    stack = np.zeros(n, np.int64)
    slices = Slices(
        planes=planes,
        value=value.astype(np.float32),
        mask=mask,
        stack_id=stack,
        slice_index=np.arange(n),
        thickness_mm=np.full(n, 3.0),
        header_pose=planes.pose,
    )
    # away from the optimum, where the gradient would vanish
    start = RigidPose(
        planes.rotation @ rotation_matrix(rng.normal(0, 0.05, (n, 3))), planes.center_mm + rng.normal(0, 0.5, (n, 3))
    )
    return slices.with_pose(start), rng.uniform(0.8, 1.2, n)


def stepped(pose: RigidPose, gain: np.ndarray, parameter: int, size: float) -> tuple[RigidPose, np.ndarray]:
    """Change of every slice's rotation (0-2) or translation (3-5) in its own frame, or of its log-gain (6)."""
    change = np.zeros((len(pose), 7))
    change[:, parameter] = size
    turned = pose.rotation @ rotation_matrix(change[:, :3])
    moved = pose.translation_mm + np.einsum("kij,kj->ki", pose.rotation, change[:, 3:6])
    return RigidPose(turned, moved), gain * np.exp(change[:, 6])


def model_pixels(slices: Slices, pose: RigidPose, gain: np.ndarray) -> np.ndarray:
    operator = VoxelOperator(slices.planes.with_pose(pose), GRID, slices.pixel_index)
    return gain[operator.plane] * operator.forward(smooth_volume().astype(np.float64))


def jacobian(slices: Slices, gain: np.ndarray, size: float = 1e-6) -> np.ndarray:
    """d model / d parameter of every masked pixel [P', 7], central differences."""
    pose = slices.planes.pose

    def at(parameter: int, step: float) -> np.ndarray:
        return model_pixels(slices, *stepped(pose, gain, parameter, step))

    return np.stack([(at(a, size) - at(a, -size)) / (2 * size) for a in range(7)], 1)


@pytest.mark.parametrize("width", [0.05, 1e6])
def test_gradient_and_hessian_against_finite_differences(width: float) -> None:
    slices, gain = make_slices()
    equations = SampledSlices(slices, smooth_volume(), GRID).evaluate(slices.planes, gain, width)
    derivative = jacobian(slices, gain)
    residual = slices.masked_value - model_pixels(slices, slices.planes.pose, gain)
    factor = 1 / (1 + (residual / width) ** 2)
    for k in range(len(slices)):
        of_slice = slices.pixel_plane == k
        j, f = derivative[of_slice], factor[of_slice]
        gradient, hessian = j.T @ (f * residual[of_slice]), j.T @ (f[:, None] * j)
        # volumes are float32; a step of 1e-6 rarely crosses a voxel border, where the derivative jumps
        assert np.linalg.norm(equations.gradient[k] - gradient) < 1e-4 * np.linalg.norm(gradient)
        assert np.linalg.norm(equations.hessian[k] - hessian) < 1e-4 * np.linalg.norm(hessian)


def test_the_gradient_is_that_of_the_cauchy_loss() -> None:
    slices, gain = make_slices(1)
    width, size = 0.1, 1e-5
    model = SampledSlices(slices, smooth_volume(), GRID)

    def energy(pose: RigidPose, gain: np.ndarray) -> np.ndarray:
        equations = model.evaluate(slices.planes.with_pose(pose), gain, width)
        return 0.5 * width**2 * equations.loss * equations.moments[:, 0]

    pose = slices.planes.pose
    found = model.evaluate(slices.planes, gain, width).gradient
    for a in range(7):
        down = (energy(*stepped(pose, gain, a, -size)) - energy(*stepped(pose, gain, a, size))) / (2 * size)
        np.testing.assert_allclose(found[:, a], down, atol=2e-3 * np.abs(found).max())


def test_statistics_are_those_of_the_pixels() -> None:
    slices, gain = make_slices(2)
    equations = SampledSlices(slices, smooth_volume(), GRID).evaluate(slices.planes, gain, 0.1)
    model = model_pixels(slices, slices.planes.pose, np.ones(len(slices)))
    for k in range(len(slices)):
        y, m = slices.masked_value[slices.pixel_plane == k].astype(float), model[slices.pixel_plane == k]
        assert equations.ncc[k] == pytest.approx(np.corrcoef(y, m)[0, 1], abs=1e-5)
        assert equations.moments[k, 0] == len(y)
        assert equations.loss[k] == pytest.approx(np.log1p(((y - gain[k] * m) / 0.1) ** 2).mean(), rel=1e-4)


def test_few_pixels_are_some_of_all_and_residuals_match() -> None:
    slices, gain = make_slices(3)
    n = len(slices.pixel_index)
    model = SampledSlices(slices, smooth_volume(), GRID, n_pixels=n // 3)
    expected = (slices.masked_value - model_pixels(slices, slices.planes.pose, gain))[thinned(n, n // 3)]
    np.testing.assert_allclose(model.residuals(slices.planes, gain), expected, atol=1e-5)
    assert model.evaluate(slices.planes, gain, 1.0).moments[:, 0].sum() == len(expected) == n // 3


def test_losses_are_those_of_the_equations() -> None:
    slices, gain = make_slices(4)
    model = SampledSlices(slices, smooth_volume(), GRID)
    expected = model.evaluate(slices.planes, gain, 0.1).loss
    np.testing.assert_allclose(model.losses(slices.planes, gain, 0.1), expected, rtol=1e-4)


def test_equations_of_many_pixels_are_sums_of_those_of_some() -> None:
    """A slice with more pixels than a run of the loop, and the same slice in two parts."""
    small, gain = make_slices(6)
    shape = np.full((4, 2), 40)
    planes = replace(small.planes, shape=shape, spacing_mm=np.full((4, 2), 0.4))
    rng = np.random.default_rng(6)
    value = rng.random(planes.n_pixels).astype(np.float32)
    chosen = rng.random(planes.n_pixels) < 0.3
    parts = []
    for mask in (np.ones(planes.n_pixels, bool), chosen, ~chosen):
        slices = replace(small, planes=planes, value=value, mask=mask)
        parts.append(SampledSlices(slices, smooth_volume(), GRID).evaluate(planes, gain, 0.1))
    whole, first, second = parts
    assert (whole.moments[:, 0] == 1600).all()
    for name in ("hessian", "gradient", "moments"):
        np.testing.assert_allclose(
            getattr(first, name) + getattr(second, name), getattr(whole, name), rtol=1e-9, atol=1e-9
        )


def test_slices_outside_the_volume_have_no_derivative_and_correlation_zero() -> None:
    slices, gain = make_slices(5)
    away = slices.with_pose(RigidPose(slices.planes.rotation, slices.planes.center_mm + 500))
    equations = SampledSlices(away, smooth_volume(), GRID).evaluate(away.planes, gain, 0.1)
    assert (equations.hessian == 0).all()
    assert (equations.ncc == 0).all()
    assert np.isfinite(equations.loss).all()


def test_correlation_of_constants_is_zero() -> None:
    n = 10.0
    moments = np.array(
        [
            [n, n, 2 * n, n, 4 * n, 2 * n],  # both constant
            [0, 0, 0, 0, 0, 0],
            [2, 3, 3, 5, 5, 5],  # (1, 2) with itself
            [2, 3, 3, 5, 5, 4],  # (1, 2) with (2, 1)
        ]
    )
    np.testing.assert_allclose(correlation(moments), [0, 0, 1, -1])
