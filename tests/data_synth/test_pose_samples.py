"""Slice sets: images that truly show what their poses say, made as they would be at inference."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from data_synth import pose_samples as slice_sets
from data_synth.heads import PhantomSubject, load_head
from data_synth.motion import LEVELS
from data_synth.pose_data import SliceSetDataModule, SliceSets
from data_synth.pose_samples import draw_slice_set
from data_synth.simulator import StackSettings, simulate_stacks
from data_synth.slice_sampling import Head, sample_slices
from data_synth.trajectories import JERK_DEG, QUIET_DEG, load_trajectories, modelled_trajectory, timed_trajectory
from g3r.acquisition.slice_images import slice_images
from g3r.acquisition.slicing import slices_from_stacks
from g3r.errors import InputError
from g3r.geometry import RigidPose, VolumeGrid


@pytest.fixture(scope="module")
def volume():
    return load_head(PhantomSubject("a", 28.0, 3), 2.0)


@pytest.fixture(scope="module")
def head(volume):
    return Head.from_volume(volume)


def shown_at(head, pose, size, pixel_mm):
    """The truth at the pixels' centres, by another interpolation."""
    at = (np.arange(size) - (size - 1) / 2) * pixel_mm
    points = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((size, size))], -1)
    world = pose.apply(np.broadcast_to(points, (len(pose), *points.shape)))
    index = VolumeGrid(head.data.shape, head.affine).index(world)
    return map_coordinates(head.data, np.moveaxis(index, -1, 0), order=1)


def test_images_show_the_truth_at_their_poses(head, rng):
    one = draw_slice_set(head, rng, max_slices=30, vary=False)
    image = one.images.image
    assert 5 <= len(image) <= 30
    expected = shown_at(head, one.true_pose, 40, 3.0)
    assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.97  # blur of pixel and thickness
    wrong = one.true_pose @ RigidPose.from_rotvec(np.full((len(image), 3), 0.15), np.full((len(image), 3), 4.0))
    assert np.corrcoef(image.ravel(), shown_at(head, wrong, 40, 3.0).ravel())[0, 1] < 0.93


def test_stacks_are_centred_by_their_headers(head, rng, monkeypatch):
    """Without motion the mean of a stack's masks, in its own axes, lies in the middle of its images."""
    monkeypatch.setattr(slice_sets, "LEVEL_SHARE", {"none": 1.0})
    monkeypatch.setattr(slice_sets, "TIMED_SHARE", 0.0)
    one = draw_slice_set(head, rng, max_slices=300, n_stacks=3, vary=False).images
    at = (np.arange(40) - 19.5) * 3.0
    for stack in range(3):
        rows = one.stack_id == stack
        inside = one.image[rows] > 0
        middle = [(inside.sum((0, 2)) @ at) / inside.sum(), (inside.sum((0, 1)) @ at) / inside.sum()]
        assert np.abs(middle).max() < 1.5  # half a pixel
        assert abs(np.average(one.position_mm[rows], weights=one.area_mm2[rows])) < 0.5


def test_the_same_images_as_at_inference(volume, head, rng):
    """Stacks of the full simulator, read as at inference, look like the fast synthesis at the same poses."""
    settings = [
        StackSettings(orientation=name, resolution_mm=1.0, thickness_mm=3.0, motion=LEVELS["mild"])
        for name in ("axial", "coronal")
    ]
    stacks = simulate_stacks(volume.data, volume.mask, volume.affine, settings, rng)
    slices = slices_from_stacks([one.stack for one in stacks])
    images = slice_images(slices, 3.0, 40)
    motion = [stacks[s].true_pose.take([k]) for s, k in zip(slices.stack_id, slices.slice_index, strict=True)]
    moved = RigidPose(np.concatenate([m.rotation for m in motion]), np.concatenate([m.translation_mm for m in motion]))
    pose = moved @ slices.header_pose @ images.frame_in_slice
    fast, _ = sample_slices(head, np.linalg.inv(head.affine), pose, images.thickness_mm, 3.0, 40)
    for image, other in zip(images.image, fast, strict=True):
        if (other > 0).sum() > 60:
            assert np.corrcoef(image.ravel(), other.ravel())[0, 1] > 0.95


def test_a_set_varies_and_is_finite(head):
    sets = [draw_slice_set(head, np.random.default_rng(seed), max_slices=24) for seed in range(12)]
    assert len({int(one.images.stack_id.max()) for one in sets}) >= 3
    known = [np.isfinite(one.images.time_rank).all() for one in sets]
    assert any(known)
    assert not all(known)
    for one in sets:
        assert len(one.images) <= 24
        assert np.isfinite(one.images.image).all()
        assert one.images.image.min() >= 0
        assert sorted(set(one.images.stack_id)) == list(range(one.images.stack_id.max() + 1))


def test_items_are_functions_of_seed_and_number():
    sources = [PhantomSubject("a", 28.0, 3)]
    first, second = (SliceSets(sources, 4, 7, 12, 3.0, 40) for _ in range(2))
    np.testing.assert_array_equal(first[5].images.image, second[5].images.image)
    assert first[5].images.image.shape != first[6].images.image.shape or not np.array_equal(
        first[5].images.image, first[6].images.image
    )


def test_batches(volume):
    data = SliceSetDataModule(source="phantom", sets_per_epoch=3, batch_size=3, max_slices=12, val_sets=6)
    data.setup()
    for sets in (data.train_sets, data.val_sets):
        sets._volumes = dict.fromkeys(range(len(sets.sources)), volume)
    batch = next(iter(data.train_dataloader()))
    n = len(batch["image"])
    assert batch["image"].shape == (n, 1, 40, 40)
    assert batch["set_of_stack"].max() == 2
    assert (batch["set_of_stack"][batch["stack"]].diff() >= 0).all()
    assert sorted(len(b["set_of_stack"]) for b in data.val_dataloader()) == [1, 2, 3, 4, 5, 6]


def test_recorded_trajectories(tmp_path, rng):
    angle, shift = rng.normal(0, 0.1, (30, 3)), rng.normal(0, 2, (30, 3))
    np.savez(tmp_path / "t.npz", rot_0=angle, trans_0=shift)
    (recorded,) = load_trajectories(tmp_path / "t.npz")
    assert recorded.rotation.shape == (30, 3, 3)
    pose = timed_trajectory(20, 7.0, np.zeros(3), 2, rng, [recorded])
    in_time = pose.translation_mm[[*range(0, 20, 2), *range(1, 20, 2)]]
    steps = np.diff(in_time, axis=0)
    assert any(np.allclose(steps, np.diff(shift[k : k + 20], axis=0)) for k in range(11))


def test_the_model_has_quiet_steps_and_jerks(rng):
    steps = []
    for _ in range(60):
        walk = modelled_trajectory(100, rng)
        turn = RigidPose(walk.rotation[1:] @ walk.rotation[:-1].transpose(0, 2, 1), np.zeros((99, 3)))
        steps.append(np.rad2deg(np.linalg.norm(turn.rotvec_rad(), axis=1)))
    size = np.concatenate(steps)
    assert np.median(size) == pytest.approx(1.6 * QUIET_DEG, rel=0.2)
    assert 0.03 < (size > JERK_DEG / 2).mean() < 0.1


@pytest.mark.parametrize("content", ["nothing", "not an npz", "no pair"])
def test_damaged_trajectories(tmp_path, content):
    path = tmp_path / "t.npz"
    if content == "not an npz":
        path.write_text("hello")
    elif content == "no pair":
        np.savez(path, rot_0=np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"expected"):
        load_trajectories(path)
