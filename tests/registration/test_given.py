"""Given poses are measured like found ones, and only moved together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import normalised_slices
from g3r.acquisition.stacks import load_stacks
from g3r.evaluation.pose_error import read_poses
from g3r.geometry import RigidPose
from g3r.registration import GivenPoses, RegistrationSettings
from g3r.registration.given import measure
from tests.cli.test_infer import files

SETTINGS = RegistrationSettings(finest_voxel_mm=1.6, max_pixels=100_000)


@pytest.fixture(scope="module")
def slices(subject: Path) -> Slices:
    return normalised_slices(load_stacks(files(subject, "stack"), files(subject, "mask"), [4.0] * 3))[0]


def given_of(subject: Path, slices: Slices) -> GivenPoses:
    """Given poses: the true motions."""
    table = read_poses(subject / "poses.tsv")
    keys = np.array(list(table.keys))
    return GivenPoses(stack_id=keys[:, 0], slice_index=keys[:, 1], motion=table.pose)


def test_true_poses_are_found_good_and_stay(subject: Path, slices: Slices) -> None:
    given = given_of(subject, slices)
    found = measure(slices, given, SETTINGS)
    expected = slices.with_motion(given.motion_of(slices)).planes
    np.testing.assert_array_equal(found.slices.planes.center_mm, expected.center_mm)
    np.testing.assert_array_equal(found.slices.planes.rotation, expected.rotation)
    np.testing.assert_array_equal(found.slices.value, slices.value)  # bias correction is for the measurement only
    assert found.held_out is not None
    assert min(found.held_out) > 0.75
    assert np.median(found.ncc) > 0.9
    assert np.median(found.weight) > 0.95
    np.testing.assert_allclose(np.log(found.gain).mean(), 0, atol=0.05)
    assert found.orientation is None


def test_single_slices_in_wrong_places_get_a_small_weight(subject: Path, slices: Slices) -> None:
    """The slices are large and 15 mm off, so that their misfit is visible."""
    given = given_of(subject, slices)
    n_pixels = np.bincount(slices.pixel_plane)
    rows = np.argsort(n_pixels)[-9::4]
    motion = given.motion_of(slices)
    wrong = motion.take(rows)
    moved = RigidPose(wrong.rotation, wrong.translation_mm + 15 * slices.header_pose.rotation[rows][:, :, 0])
    bad = GivenPoses(stack_id=slices.stack_id, slice_index=slices.slice_index, motion=motion.with_rows(rows, moved))
    found = measure(slices, bad, SETTINGS)
    good = measure(slices, given, SETTINGS)
    assert (found.weight[rows] < 0.5).all()
    assert (good.weight[rows] > 0.9).all()
    assert (found.ncc[rows] < good.ncc[rows] - 0.05).all()
    assert np.median(found.weight) > 0.95


def test_a_single_stack_is_not_weighed_by_itself(subject: Path, slices: Slices) -> None:
    given, alone = given_of(subject, slices), slices.take(slices.stack_id == 1)
    found = measure(alone, given, SETTINGS)
    assert found.held_out is None
    np.testing.assert_array_equal(found.weight, 1)
    np.testing.assert_array_equal(found.gain, 1)
    assert np.median(found.ncc) > 0.9
