"""The open shear of two orientations as a parameter of the fit: it changes no pixel, and the fit finds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.orientations import mean_normals
from g3r.acquisition.planes import Slices
from g3r.fitting.open_shear import OpenShear
from g3r.fitting.parameters import Block, FitParameters, LearningRates
from g3r.fitting.slice_parameters import slice_blocks
from g3r.fitting.slice_stage import SliceLoss, SliceStageSettings
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import RigidPose
from g3r.geometry.quaternion import rotation_from_quaternion
from g3r.registration.open_strain import open_strain
from tests.fitting.scene import fit, make_slices, true_cloud, true_volume
from tests.gaussians.scenes import cloud_of

X, Y, Z = np.eye(3)


def turned_slices() -> Slices:
    """Two stacks whose slices are rotated against each other, as by jerks, with the pixels of the true cloud."""
    slices = make_slices()
    slices = slices.take(slices.stack_id < 2)
    turn = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.12, (len(slices), 3))).as_matrix()
    pose = slices.planes.pose
    slices = slices.with_pose(RigidPose(pose.rotation @ turn, pose.translation_mm))
    value = render(true_cloud(), slices.planes, cutoff_sigma=6.0).numpy()
    mask = np.linalg.norm(slices.planes.pixel_world_mm(), axis=1) < 10
    return replace(slices, value=value, mask=mask)


def parameters_of(slices: Slices) -> tuple[FitParameters, OpenShear]:
    cloud = true_cloud()
    shear = OpenShear.of(slices, cloud.origin_mm)
    assert shear is not None
    return FitParameters(cloud, LearningRates(), blocks_of(slices)), shear


def blocks_of(slices: Slices, *, optimise_poses: bool = True) -> dict[str, Block]:
    return slice_blocks(slices, np.ones(len(slices)), None, LearningRates(), optimise_poses)


def sheared(slices: Slices, amount: float) -> tuple[GaussianCloud, Slices]:
    """The true cloud and slices after a common shear."""
    parameters, shear = parameters_of(slices)
    parameters.value["shear"][0] = amount
    shear.fold(parameters)
    assert parameters.value["shear"][0] == 0
    pose = slices.planes.pose
    rotation = pose.rotation @ Rotation.from_rotvec(parameters.value["rotation"]).as_matrix()
    there = slices.with_pose(RigidPose(rotation, pose.translation_mm + parameters.value["translation"]))
    return reshaped(parameters.cloud(), np.eye(3) + amount * shear.strain), there


def reshaped(cloud: GaussianCloud, motion: np.ndarray) -> GaussianCloud:
    """Gaussians whose shapes also follow a linear motion [3, 3], which the fit leaves to their own parameters."""
    frame = rotation_from_quaternion(cloud.quaternion_wxyz).numpy()
    half = motion @ frame * np.exp(cloud.log_scale.numpy())[:, None]
    variance, axes = np.linalg.eigh(half @ half.transpose(0, 2, 1))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    turn = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return cloud_of(cloud.mean_mm.numpy(), np.log(variance) / 2, turn, cloud.amplitude.numpy())


def test_slices_and_gaussians_that_move_together_explain_the_same_pixels() -> None:
    still = make_slices()
    still = still.take(still.stack_id < 2)
    cloud, slices = sheared(still, 0.04)
    before, together, alone = (
        render(head, planes.planes, cutoff_sigma=6.0).numpy()
        for head, planes in ((true_cloud(), still), (cloud, slices), (true_cloud(), slices))
    )
    # second-order error, and the error of the profile, which rotates with the slices
    assert np.abs(together - before).mean() < 0.1 * np.abs(alone - before).mean()


def test_the_slope_is_the_finite_difference_of_the_loss() -> None:
    slices = turned_slices()
    noise = np.random.default_rng(2).normal(0, 0.05, slices.value.shape).astype(np.float32)
    slices = replace(slices, value=slices.value + noise)

    def loss_at(amount: float) -> tuple[float, float]:
        parameters, _ = parameters_of(slices)
        ones = np.ones(len(slices))
        # all slices; cut-off tails of Gaussians would make the loss jump
        settings = SliceStageSettings(n_parts=1, scale_weight=0.0, cutoff_sigma=6.0)
        loss = SliceLoss(
            parameters, slices, gain=ones, slice_weight=ones, bias_field=None, prior=None, settings=settings
        )
        parameters.value["shear"][0] = amount
        loss.unknowns.fold()
        return loss.evaluate(0.5)[0], float(parameters.gradient["shear"][0])

    step = 1e-3
    slope = (loss_at(step)[0] - loss_at(-step)[0]) / (2 * step)
    assert loss_at(0.0)[1] == pytest.approx(slope, rel=0.03)


def strain_left(slices: Slices, true: Slices) -> float:
    """Share of the open strain in the difference of the poses from the true ones."""
    strain = open_strain(mean_normals(true))
    assert strain is not None
    place = true.planes.center_mm - true.planes.center_mm.mean(0)
    away = slices.planes.center_mm - true.planes.center_mm
    away = away - away.mean(0)
    # a common rotation of all slices is not an error
    turns = [np.cross(axis, place).ravel() for axis in np.eye(3)]
    found = np.linalg.lstsq(np.stack([(place @ strain).ravel(), *turns], 1), away.ravel(), rcond=None)[0]
    return float(found[0])


def test_a_fit_finds_the_shear_that_slices_alone_are_slow_to_find() -> None:
    true = turned_slices()
    _, start = sheared(true, 0.06)
    left = {}
    for rate in (0.0, 2e-3):
        settings = SliceStageSettings(n_steps=80, rates=replace(LearningRates(), shear=rate))
        left[rate] = strain_left(fit(true_volume(), start, settings=settings).slices, true)
    assert abs(left[2e-3]) < 0.6 * abs(left[0.0])


def test_only_slices_that_move_in_two_orientations_have_such_a_parameter() -> None:
    three = make_slices()
    two = three.take(three.stack_id < 2)
    assert "shear" in blocks_of(two)
    assert "shear" not in blocks_of(two, optimise_poses=False)
    assert "shear" not in blocks_of(three)


def test_a_stack_without_an_orientation_leaves_none_open() -> None:
    slices = make_slices()
    slices = slices.take(slices.stack_id < 2)
    pose, own = slices.planes.pose, np.flatnonzero(slices.stack_id == 1)
    turn = Rotation.from_rotvec(np.linspace(0, 2 * np.pi, len(own), endpoint=False)[:, None] * X).as_matrix()
    rotation = pose.rotation.copy()
    rotation[own] = rotation[own] @ turn
    radial = slices.with_pose(RigidPose(rotation, pose.translation_mm))
    assert np.linalg.norm(mean_normals(radial)[1]) < 1e-9
    assert OpenShear.of(radial, true_cloud().origin_mm) is None
