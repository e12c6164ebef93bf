"""Bias correction of stacks before registration."""

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.bias_basis import LENGTH_MM
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.bias_correction import bias_corrected
from tests.registration.moving_heads import turned_about


def shaded(slices: Slices, strength: float) -> Slices:
    """A different smooth factor in plane for each stack, constant through its slices."""
    planes = slices.planes.with_pose(slices.header_pose)
    plane, world_mm = planes.plane_id(), planes.pixel_world_mm()
    value = slices.value.copy()
    for stack in range(3):
        rows = (slices.stack_id == stack)[plane]
        axes = slices.header_pose.rotation[slices.stack_id == stack][0][:, :2]
        x, y = (world_mm[rows] @ axes / LENGTH_MM).T
        a, b, c = strength * np.random.default_rng(stack).normal(size=3)
        value[rows] *= np.exp(a * x + b * y + c * x * y).astype(np.float32)
    return replace(slices, value=value)


def log_ratio_spread(a: Slices, b: Slices) -> float:
    """Difference of two versions of the slices beyond one factor per stack."""
    ratio = np.log(np.maximum(a.masked_value, 1e-3) / np.maximum(b.masked_value, 1e-3))
    stack = a.stack_id[a.pixel_plane]
    return float(np.mean([ratio[stack == s].std() for s in range(3)]))


def test_shaded_and_unshaded_stacks_come_out_alike(still_slices: tuple[Slices, RigidPose]) -> None:
    slices, _ = still_slices
    dark = shaded(slices, 1.0)
    before, after = (log_ratio_spread(dark, slices), log_ratio_spread(bias_corrected(dark), bias_corrected(slices)))
    assert before > 0.1
    assert after < 0.15 * before


def test_slices_keep_their_gains_and_everything_else(still_slices: tuple[Slices, RigidPose]) -> None:
    slices, _ = still_slices
    gain = np.exp(np.random.default_rng(0).normal(0, 0.1, len(slices)))[slices.planes.plane_id()]
    flat = bias_corrected(slices)
    gained = bias_corrected(replace(slices, value=(slices.value * gain).astype(np.float32)))
    ratio = np.log(gained.masked_value / flat.masked_value)
    plane = slices.pixel_plane
    within = np.mean([ratio[plane == k].std() for k in range(len(slices))])
    assert within < 0.3 * np.log(gain).std()
    np.testing.assert_array_equal(flat.mask, slices.mask)
    np.testing.assert_array_equal(flat.planes.center_mm, slices.planes.center_mm)
    assert not np.shares_memory(flat.value, slices.value)


def test_the_scanners_frame_and_the_present_poses_do_not_matter(still_slices: tuple[Slices, RigidPose]) -> None:
    slices, _ = still_slices
    turn = turned_about(np.zeros(3), np.array([1.0, -2.0, 0.5]), np.array([30.0, 0, -60]))
    turned = replace(slices, header_pose=turn @ slices.header_pose)
    np.testing.assert_allclose(bias_corrected(turned).value, bias_corrected(slices).value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("constant", [0.0, -1.0, 2.0])
def test_stacks_without_contrast_stay_as_they_are(still_slices: tuple[Slices, RigidPose], constant: float) -> None:
    slices, _ = still_slices
    flat = bias_corrected(replace(slices, value=np.full_like(slices.value, constant)))
    np.testing.assert_allclose(flat.value, constant, rtol=1e-3)
