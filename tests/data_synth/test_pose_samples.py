"""Slice sets: images that agree with their true poses, and with images made at inference."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from data_synth import pose_samples, stack_planning
from data_synth.atlas import TruthVolume
from data_synth.motion import LEVELS
from data_synth.pose_samples import draw_slice_set, log_bias
from data_synth.simulator import StackSettings, simulate_stacks
from data_synth.slice_sampling import Head, sample_slices
from g3r.acquisition.slice_images import slice_images
from g3r.acquisition.slicing import slices_from_stacks
from g3r.geometry import RigidPose, VolumeGrid


@pytest.fixture(scope="module")
def sampled(centred_head: TruthVolume) -> Head:
    return Head.from_volume(centred_head)


def shown_at(sampled: Head, pose: RigidPose, size: int, pixel_mm: float) -> np.ndarray:
    """The truth at the pixel centres, by an independent interpolation."""
    at = (np.arange(size) - (size - 1) / 2) * pixel_mm
    points = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((size, size))], -1)
    world = pose.apply(np.broadcast_to(points, (len(pose), *points.shape)))
    index = VolumeGrid(sampled.data.shape, sampled.affine).index(world)
    return map_coordinates(sampled.data, np.moveaxis(index, -1, 0), order=1)


@pytest.fixture
def unvaried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Heads keep their shape and intensities; no noise, gain or dropout."""
    monkeypatch.setattr(pose_samples, "_random_shape", lambda rng: np.eye(3))
    monkeypatch.setattr(pose_samples, "_random_intensities", lambda image, *others: image)


@pytest.mark.usefixtures("unvaried")
def test_images_show_the_truth_at_their_poses(sampled: Head, rng: np.random.Generator) -> None:
    one = draw_slice_set(sampled, rng, max_slices=30)
    image = one.images.image
    assert 5 <= len(image) <= 30
    expected = shown_at(sampled, one.true_pose, 40, 3.0)
    assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.97  # blur of pixel and thickness
    wrong = one.true_pose @ RigidPose.from_rotvec(np.full((len(image), 3), 0.15), np.full((len(image), 3), 4.0))
    assert np.corrcoef(image.ravel(), shown_at(sampled, wrong, 40, 3.0).ravel())[0, 1] < 0.93


@pytest.mark.usefixtures("unvaried")
def test_stacks_are_centred_by_their_headers(
    sampled: Head, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without motion, the centroid of a stack's masks, in its own axes, lies at the centre of its images."""
    monkeypatch.setattr(stack_planning, "LEVEL_SHARE", {"none": 1.0})
    monkeypatch.setattr(stack_planning, "TIMED_SHARE", 0.0)
    one = draw_slice_set(sampled, rng, max_slices=300, n_stacks=3).images
    at = (np.arange(40) - 19.5) * 3.0
    for stack in range(3):
        rows = one.stack_id == stack
        inside = one.image[rows] > 0
        middle = [(inside.sum((0, 2)) @ at) / inside.sum(), (inside.sum((0, 1)) @ at) / inside.sum()]
        assert np.abs(middle).max() < 1.5  # half a pixel
        assert abs(np.average(one.position_mm[rows], weights=one.area_mm2[rows])) < 0.5


def test_the_same_images_as_at_inference(centred_head: TruthVolume, sampled: Head, rng: np.random.Generator) -> None:
    """Stacks of the full simulator, read as at inference, equal the fast synthesis at the same poses."""
    settings = [
        StackSettings(orientation=name, resolution_mm=1.0, thickness_mm=3.0, motion=LEVELS["mild"])
        for name in ("axial", "coronal")
    ]
    stacks = simulate_stacks(centred_head.data, centred_head.mask, centred_head.affine, settings, rng)
    slices = slices_from_stacks([one.stack for one in stacks])
    images = slice_images(slices, 3.0, 40)
    motion = [stacks[s].true_pose.take([k]) for s, k in zip(slices.stack_id, slices.slice_index, strict=True)]
    pose = RigidPose.concatenated(motion) @ slices.header_pose @ images.frame_in_slice
    fast, _ = sample_slices(sampled, np.linalg.inv(sampled.affine).astype(float), pose, images.thickness_mm, 3.0, 40)
    for image, other in zip(images.image, fast, strict=True):
        if (other > 0).sum() > 60:
            assert np.corrcoef(image.ravel(), other.ravel())[0, 1] > 0.95


def test_slices_through_one_point_have_one_bias_factor_there(rng: np.random.Generator) -> None:
    slope_per_mm, point_mm = np.array([0.004, -0.003, 0.006]), np.array([12.0, -30.0, 21.0])
    pixel_mm, size, pixels = 3.0, 40, np.array([[4, 31], [22, 9], [35, 35]])
    turned = RigidPose.from_rotvec(rng.normal(0, 1, (3, 3)), np.zeros((3, 3)))
    in_slice = np.column_stack([(pixels - (size - 1) / 2) * pixel_mm, np.zeros(3)])
    pose = RigidPose(turned.rotation, point_mm - turned.apply(in_slice))
    found = log_bias(slope_per_mm, pose, pixel_mm, size)
    assert found.shape == (3, size, size)
    np.testing.assert_allclose(found[np.arange(3), pixels[:, 0], pixels[:, 1]], slope_per_mm @ point_mm)


def test_a_set_varies_and_is_finite(sampled: Head) -> None:
    sets = [draw_slice_set(sampled, np.random.default_rng(seed), max_slices=24) for seed in range(12)]
    assert len({int(one.images.stack_id.max()) for one in sets}) >= 3
    known = [np.isfinite(one.images.time_rank).all() for one in sets]
    assert any(known)
    assert not all(known)
    for one in sets:
        assert len(one.images) <= 24
        assert np.isfinite(one.images.image).all()
        assert one.images.image.min() >= 0
        assert sorted(set(one.images.stack_id)) == list(range(one.images.stack_id.max() + 1))
