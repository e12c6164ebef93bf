"""Invariances of the pixels, and the effect of gains, twists and amplitudes."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import RigidPose
from tests.gaussians.scenes import assert_same_images, images, make_cloud, make_planes, single


def test_moving_the_whole_world_changes_nothing() -> None:
    cloud, planes = make_cloud(5, 10), make_planes(5)
    motion = RigidPose.from_rotvec([[0.7, -1.1, 0.4]], [[12.0, -30, 8]])
    turn = Rotation.from_matrix(motion.rotation[0])
    wxyz = cloud.quaternion_wxyz.numpy()
    turned = (turn * Rotation.from_quat(np.roll(wxyz, -1, axis=1))).as_quat()
    moved = GaussianCloud.of(
        [
            torch.tensor(turn.apply(cloud.mean_mm.numpy())),
            cloud.log_scale,
            torch.tensor(np.roll(turned, 1, axis=1)),
            cloud.amplitude,
        ],
        motion.apply(cloud.origin_mm[None, None])[0, 0],
    )
    assert_same_images((cloud, planes), (moved, planes.moved(motion)))


def test_the_order_of_gaussians_does_not_matter() -> None:
    cloud, planes = make_cloud(6, 30), make_planes(6)
    assert_same_images(
        (cloud, planes), (cloud.take(torch.randperm(30, generator=torch.Generator().manual_seed(0))), planes)
    )


def test_q_and_minus_q_and_their_length_do_not_matter() -> None:
    cloud, planes = make_cloud(7, 10), make_planes(7)
    for factor in (-1.0, 3.7, -1e-3):
        other = GaussianCloud.of(
            [cloud.mean_mm, cloud.log_scale, factor * cloud.quaternion_wxyz, cloud.amplitude], cloud.origin_mm
        )
        assert_same_images((cloud, planes), (other, planes))


def test_the_origin_is_only_a_number() -> None:
    cloud, planes = make_cloud(8, 10), make_planes(8)
    other = GaussianCloud.of([cloud.mean_mm + 3.0, *cloud.parameters[1:]], cloud.origin_mm - 3.0)
    assert_same_images((cloud, planes), (other, planes))


def test_ten_metres_from_the_origin_no_digit_is_lost() -> None:
    near, far = np.zeros(3), np.array([1e4, -1e4, 1e4])
    cloud, planes = make_cloud(9, 10, origin=near), make_planes(9, origin=near)
    away = GaussianCloud.of([*cloud.parameters], far)
    moved = Planes(
        rotation=planes.rotation,
        center_mm=planes.center_mm + far,
        spacing_mm=planes.spacing_mm,
        shape=planes.shape,
        psf_var_mm2=planes.psf_var_mm2,
    )
    for (first, _), (second, _) in zip(images(cloud, planes), images(away, moved), strict=True):
        assert np.abs(first - second).max() < 1e-6 * np.abs(first).max()


def test_intensities_scale_with_the_amplitudes() -> None:
    cloud, planes = single(make_cloud(10, 10)), make_planes(10)
    plain = render(cloud, planes)
    for factor in (1e-6, 1e6, -1.0):
        torch.testing.assert_close(
            render(cloud.with_amplitude(cloud.amplitude * factor), planes),
            plain * factor,
            rtol=2e-5,
            atol=1e-6 * abs(factor),
        )


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_gain_and_twist_are_what_they_say(backend: str) -> None:
    cloud, planes = make_cloud(11, 10), make_planes(11)
    cloud = cloud if backend == "reference" else single(cloud)
    rng = np.random.default_rng(11)
    twist = rng.normal(0, 0.3, (len(planes), 6))
    gain = rng.uniform(0.5, 2, len(planes))
    turned = planes.rotation @ Rotation.from_rotvec(twist[:, :3]).as_matrix()
    by_hand = planes.with_pose(RigidPose(turned, planes.center_mm + twist[:, 3:]))
    expected = render(cloud, by_hand, backend=backend).numpy() * np.repeat(gain, np.diff(planes.offset))
    found = render(
        cloud,
        planes,
        backend=backend,
        twist=torch.tensor(twist, dtype=cloud.amplitude.dtype),
        log_gain=torch.tensor(np.log(gain), dtype=cloud.amplitude.dtype),
    )
    assert np.abs(found.numpy() - expected).max() < (1e-12 if backend == "reference" else 2e-5)
