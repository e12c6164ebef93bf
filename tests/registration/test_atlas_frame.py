"""Standard orientation of a single stack: all orientations are tried, and an ambiguous one is reported."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.heads import PhantomSubject
from data_synth.phantom import Phantom
from data_synth.template import atlas_templates
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import RIVAL_DEG, Orientation, into_atlas, standard_orientation
from g3r.registration.atlas_search import nearest_templates
from g3r.registration.thresholds import MIN_RIVAL_MARGIN
from tests.registration.moving_heads import STILL, as_slices, rotation_angle_deg, simulated, turned_about

START_DEG = 150.0
"""Simulated wrong end of the search, far from the truth, which is the header poses."""


@pytest.fixture(scope="module")
def own_template() -> AtlasTemplate:
    """The head itself as a template of its age."""
    return atlas_templates([PhantomSubject("the head", 24.0, 0)], 2.0, weeks=(24,))


def found_from_far(slices: Slices, template: AtlasTemplate) -> Orientation | None:
    """The standard orientation of slices after a search that ended at a wrong one."""
    middle = slices.planes.center_mm.mean(0)
    far = turned_about(middle, np.deg2rad([START_DEG, 0, 0]), np.zeros(3))
    start = RigidPose.concatenated([far] * len(slices))
    return standard_orientation(slices, nearest_templates(slices, template), start, np.random.default_rng(0))


def turn_deg(found: Orientation, slices: Slices) -> float:
    """Rotation angle of the whole head from the truth."""
    return rotation_angle_deg((found.pose @ slices.planes.pose.inverse()).rotation[0])


def test_a_single_stack_is_oriented_from_everywhere(head: Phantom, own_template: AtlasTemplate) -> None:
    slices, _ = as_slices(simulated(head, STILL, n_stacks=1, seed=2))
    found = found_from_far(slices, own_template)
    assert found is not None
    assert turn_deg(found, slices) < 10
    assert not found.is_doubtful


def test_several_stacks_are_held_by_their_headers(head: Phantom, own_template: AtlasTemplate) -> None:
    slices, _ = as_slices(simulated(head, STILL, n_stacks=2, seed=2))
    found = found_from_far(slices, own_template)
    assert found is None or (found.rival is None and turn_deg(found, slices) > RIVAL_DEG)


@pytest.mark.parametrize("far_deg", [0.0, START_DEG])
def test_stacks_that_hold_together_are_moved_into_the_atlas_from_everywhere(
    head: Phantom, own_template: AtlasTemplate, far_deg: float
) -> None:
    slices, _ = as_slices(simulated(head, STILL, seed=2))
    far = turned_about(slices.planes.center_mm.mean(0), np.deg2rad([far_deg, 0, 0]), np.array([10.0, -8.0, 5.0]))
    held = RigidPose.concatenated([far] * len(slices))
    found = into_atlas(slices, held, nearest_templates(slices, own_template)[0], np.random.default_rng(0))
    assert rotation_angle_deg(found.rotation[0]) < 10
    corners = slices.planes.corners_mm()
    assert np.linalg.norm(found.apply(corners) - corners, axis=-1).max() < 8
    relative = found @ found.take([0] * len(slices)).inverse()
    np.testing.assert_allclose(relative.rotation, np.broadcast_to(np.eye(3), relative.rotation.shape), atol=1e-9)


def test_a_template_that_looks_alike_the_other_way_round_makes_the_orientation_doubtful(
    head: Phantom, own_template: AtlasTemplate
) -> None:
    volume = own_template.volume[0]
    inside = np.argwhere(volume > 0)
    low, high = inside.min(0), inside.max(0) + 1
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    both = np.zeros_like(volume)
    both[box] = (volume[box] + volume[box][::-1, ::-1]) / 2  # rotated by 180 degrees about the third axis
    slices, _ = as_slices(simulated(head, STILL, n_stacks=1, seed=2))
    found = found_from_far(slices, replace(own_template, volume=both[None]))
    assert found is not None
    assert found.rival is not None
    assert found.correlation - found.rival < MIN_RIVAL_MARGIN
    assert found.is_doubtful


@pytest.mark.parametrize(("rival", "doubtful"), [(None, False), (0.60, False), (0.69, True), (0.7, True)])
def test_doubt_is_a_matter_of_the_margin(rival: float | None, doubtful: bool) -> None:
    pose = RigidPose(Rotation.identity(1).as_matrix(), np.zeros((1, 3)))
    found = Orientation(pose=pose, correlation=0.7, weeks=28.0, scale=1.0, rival=rival)
    assert found.is_doubtful is doubtful
