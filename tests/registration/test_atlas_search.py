"""The atlas search finds a head in any orientation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.phantom import Phantom
from data_synth.simulator import SimulatedStack
from g3r.acquisition.area_profile import head_volume_mm3
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration import RegistrationSettings, register
from g3r.registration.atlas_frame import standard_orientation
from g3r.registration.atlas_search import (
    nearest_templates,
    place_in_atlas,
    scaled_template,
    template_fits,
    template_orientations,
)
from g3r.registration.pose_sampling import angle_deg, rotations_about, uniform_rotations
from g3r.registration.similarity import StackSamples
from g3r.registration.so3_search import CORRELATION_MARGIN, best_orientations, place_around, stack_orientations
from tests.registration.moving_heads import (
    Moving,
    as_slices,
    pixel_errors_mm,
    rotation_angle_deg,
    simulated,
    turned_about,
)

TURNS = {"180 x": [np.pi, 0, 0], "180 z": [0, 0, np.pi], "oblique": [2.0, -1.2, 1.5]}


PLACE_MM = np.array([20.0, -30.0, 40.0])


def turned_phantom(head: Phantom, rotation: np.ndarray) -> Phantom:
    """The head in another orientation in the scanner, away from the origin."""
    affine = head.affine.copy()
    affine[:3] = rotation @ head.affine[:3]
    affine[:3, 3] += PLACE_MM
    return replace(head, affine=affine)


def headers_turned(slices: Slices, rotvec: list[float]) -> Slices:
    """The same slices with headers that are rotated as a whole."""
    turned = turned_about(np.zeros(3), np.array(rotvec), PLACE_MM) @ slices.header_pose
    return replace(slices.with_pose(turned), header_pose=turned)


@pytest.mark.parametrize(("turn", "order"), [("180 x", (2, 0, 1)), ("180 z", (0, 1, 2)), ("oblique", (1, 2, 0))])
def test_a_head_in_any_orientation_is_found_and_set_upright(
    head: Phantom, template: AtlasTemplate, turn: str, order: tuple[int, ...]
) -> None:
    rotation = Rotation.from_rotvec(TURNS[turn]).as_matrix()
    stacks = simulated(turned_phantom(head, rotation))
    slices, truth = as_slices([stacks[k] for k in order])
    samples = StackSamples.of_all(slices)
    rng = np.random.default_rng(0)
    placed = place_in_atlas(slices, samples, template, rng)
    motion = placed.motion(len(slices), samples)
    error = pixel_errors_mm(slices.with_motion(motion), truth)
    assert np.median(error) < 2
    assert error.max() < 5
    assert max(angle_deg(m @ rotation, np.eye(3)) for m in motion.rotation) < 15
    # the atlas frame is the phantom's frame except for the rotation
    upright = standard_orientation(slices, placed.templates, motion, rng)
    assert upright is not None
    back = upright.pose @ slices.planes.pose.inverse()
    np.testing.assert_allclose(back.rotation, back.rotation[:1].repeat(len(back), 0), atol=1e-9)
    assert rotation_angle_deg(back.rotation[0] @ rotation) < 5
    middle = back.apply(np.tile(PLACE_MM, (len(back), 1)))[0]
    assert abs(middle[0]) < 1.5  # the mid-sagittal plane is at x = 0
    assert upright.correlation > 0.7


def test_headers_turned_as_a_whole_change_nothing(still: list[SimulatedStack], template: AtlasTemplate) -> None:
    slices, _ = as_slices(still)
    settings = RegistrationSettings(network=False, stacks=False, segments=False, n_rounds=0, finest_voxel_mm=3.0)
    plain = register(slices, settings, template=template)
    assert plain.orientation is not None
    # the phantom has the orientation of the atlas
    assert max(rotation_angle_deg(r) for r in plain.slices.world_from_header().rotation) < 5
    turned = register(headers_turned(slices, [0, 0, np.pi / 2]), settings, template=template)
    assert turned.orientation is not None
    apart = plain.slices.planes.pose.inverse() @ turned.slices.planes.pose
    assert max(rotation_angle_deg(r) for r in apart.rotation) < 5
    away = plain.slices.planes.pixel_world_mm() - turned.slices.planes.pixel_world_mm()
    assert np.linalg.norm(away, axis=1).mean() < 2


def test_the_result_of_a_moving_head_stands_upright(moving: Moving) -> None:
    """The phantom's frame is the atlas frame, so the true motions lead into it."""
    found = moving.estimate.slices.world_from_header()
    common = found @ moving.truth.inverse()
    middle = len(found) // 2
    angles = sorted(rotation_angle_deg(r) for r in common.rotation)
    assert angles[middle] < 5
    centers = moving.slices.header_pose.translation_mm[:, None]
    away = np.linalg.norm((found.apply(centers) - moving.truth.apply(centers))[:, 0], axis=1)
    assert np.median(away) < 8  # the centre of the mean head differs slightly from the phantom's


def test_scanner_space_on_request(still: list[SimulatedStack], template: AtlasTemplate) -> None:
    slices = headers_turned(as_slices(still[:1])[0], [0, np.pi, 0])
    settings = RegistrationSettings(segments=False, finest_voxel_mm=3.0, standard_orientation=False)
    estimate = register(slices, settings, template=template)
    assert estimate.orientation is None
    np.testing.assert_allclose(estimate.slices.world_from_header().rotvec_rad(), 0, atol=1e-6)
    upright = register(slices, replace(settings, standard_orientation=True), template=template)
    assert upright.orientation is not None
    assert min(rotation_angle_deg(r) for r in upright.slices.world_from_header().rotation) > 160


def test_a_head_unlike_any_mean_head_gets_no_standard_orientation(
    still_slices: tuple[Slices, RigidPose], template: AtlasTemplate
) -> None:
    slices, _ = still_slices
    noise = np.random.default_rng(0).random(len(slices.value)).astype(np.float32)
    scattered = slices.with_pose(
        RigidPose(
            slices.planes.rotation, slices.planes.center_mm + np.random.default_rng(1).normal(0, 20, (len(slices), 3))
        )
    )
    heads = nearest_templates(slices, template)
    still = RigidPose.identity(len(slices))
    rng = np.random.default_rng(0)
    assert standard_orientation(replace(scattered, value=noise), heads, still, rng) is None
    assert standard_orientation(slices, heads, still, rng) is not None


def test_masks_of_another_size_than_any_head_are_refused(
    still_slices: tuple[Slices, RigidPose], template: AtlasTemplate
) -> None:
    slices, _ = still_slices

    def enlarged(factor: float) -> Slices:
        return replace(slices, planes=replace(slices.planes, spacing_mm=slices.planes.spacing_mm * factor))

    assert template_fits(slices, template)
    assert template_fits(enlarged(1.2), template)
    assert not template_fits(enlarged(3.0), template)
    assert not template_fits(enlarged(0.5), template)
    # the estimate continues without the template
    settings = RegistrationSettings(network=False, stacks=False, segments=False, n_rounds=0, finest_voxel_mm=3.0)
    estimate = register(enlarged(3.0), settings, template=template)
    assert estimate.orientation is None
    assert set(estimate.initialisations) == {"headers"}


def test_a_scaled_head_has_the_volume_asked_for_and_the_same_middle(template: AtlasTemplate) -> None:
    for volume_mm3 in (1e5, 4e5):
        for number in range(len(template)):
            head = scaled_template(template, number, volume_mm3)
            inside = template.volume[number] > 0
            assert inside.sum() * head.grid.voxel_volume_mm3 == pytest.approx(volume_mm3)
            np.testing.assert_allclose(head.grid.world(np.argwhere(inside)).mean(0), head.center_mm, atol=1e-9)
            np.testing.assert_allclose(head.grid.spacing_mm, head.scale * template.grid.spacing_mm)
            assert head.weeks == template.weeks[number]


def test_near_heads_are_the_three_of_about_the_size(
    still_slices: tuple[Slices, RigidPose], template: AtlasTemplate
) -> None:
    slices, _ = still_slices
    one = template.volume[0]
    inside = np.argwhere(one > 0)
    middle = inside.mean(0)
    sizes = []
    for factor in (0.4, 0.6, 1.0, 0.8):
        smaller = np.zeros_like(one)
        index = np.rint(middle + factor * (inside - middle)).astype(int)
        smaller[tuple(index.T)] = 1.0
        sizes.append(smaller)
    several = AtlasTemplate(np.stack(sizes), template.affine, np.array([20.0, 22, 28, 24]))
    near = nearest_templates(slices, several)
    assert [head.weeks for head in near] == [28, 24, 22]
    assert len(nearest_templates(slices, template)) == 2


def test_the_head_that_looks_alike_decides(still_slices: tuple[Slices, RigidPose], template: AtlasTemplate) -> None:
    """A mean head is preferred to noise of the same shape, in either order."""
    slices, _ = still_slices
    inside = template.volume[0] > 0
    noise = np.where(inside, np.random.default_rng(0).random(inside.shape), 0).astype(np.float32)
    two = AtlasTemplate(np.stack([noise, template.volume[0]]), template.affine, np.array([23.0, 24.0]))
    heads = nearest_templates(slices, two)
    still = RigidPose.identity(len(slices))
    for order in (heads, heads[::-1]):
        found = standard_orientation(slices, order, still, np.random.default_rng(0))
        assert found is not None
        assert found.weeks == 24


def test_the_whole_head_turned_is_among_the_orientations_to_follow(
    still_slices: tuple[Slices, RigidPose], template: AtlasTemplate
) -> None:
    slices, _ = still_slices
    head = scaled_template(template, 0, head_volume_mm3(slices))
    turned = headers_turned(slices, [2.0, -1.2, 1.5])
    back = Rotation.from_rotvec([2.0, -1.2, 1.5]).as_matrix().T
    first = template_orientations(StackSamples.of_all(turned), head)[0]
    assert angle_deg(first, back) < 20


def test_one_stack_upside_down_is_found_in_a_volume(head: Phantom, still_slices: tuple[Slices, RigidPose]) -> None:
    """The true orientation is among those to follow for a stack, and its motion segments are then placed correctly."""
    slices, _ = still_slices
    grid = VolumeGrid(head.t2.shape, head.affine)
    volume = (head.t2 * head.mask / 1000).astype(np.float32)
    stack = headers_turned(slices.take(slices.stack_id == 1), [np.pi, 0, 0])
    (sample,) = StackSamples.of_all(stack)
    target = grid.world(np.argwhere(head.mask)).mean(0)
    bases = stack_orientations(sample, target, volume, grid)
    away = [float(angle_deg(base, Rotation.from_rotvec([np.pi, 0, 0]).as_matrix().T)) for base in bases]
    assert min(away) < 20
    placed = place_around(sample, bases[int(np.argmin(away))], target, volume, grid)
    error = np.linalg.norm(
        stack.with_motion(placed.motion).planes.center_mm - slices.take(slices.stack_id == 1).planes.center_mm, axis=1
    )
    assert np.median(error) < 6  # the search lattice has steps of 7 mm and 10 degrees
    assert placed.segments.n_segments <= 3


def test_orientations_to_follow_are_few_apart_and_best_first() -> None:
    rotation = uniform_rotations(3000)
    centers = rotations_about(rotation[[100, 900, 2500]], np.zeros(3), np.zeros(3)).rotation
    agreement = np.zeros(len(rotation))
    for height, center in zip((0.70, 0.75, 0.60), centers, strict=True):
        agreement = np.maximum(agreement, height - angle_deg(rotation, center) / 200)
    found = best_orientations(rotation, agreement, 4, 40.0)
    assert len(found) == 2  # the third scores lower by more than the margin
    assert angle_deg(found[0], centers[1]) < 1e-4
    assert angle_deg(found[1], centers[0]) < 1e-4
    assert CORRELATION_MARGIN < 0.15
    assert len(best_orientations(rotation, agreement, 1, 40.0)) == 1
