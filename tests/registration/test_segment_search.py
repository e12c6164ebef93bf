"""Motion segments of all stacks: jerks are corrected, rigid stacks keep one motion."""

import numpy as np

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.head_movement import segments_of
from g3r.registration.held_out import held_out_score, predict, volume_without
from g3r.registration.motion_segments import head_distance_mm
from g3r.registration.placement import refine_placement
from g3r.registration.segment_search import aligned_to, collapse_to_rigid, refine_segments, rigid_or_segments
from g3r.registration.similarity import StackSamples
from g3r.registration.thresholds import MIN_SINGLE_GAIN_PER_SAMPLE
from tests.registration.moving_heads import (
    STILL,
    Moving,
    as_slices,
    pixel_errors_mm,
    simulated,
    slices_disturbed,
    stack_moved,
    turned_about,
)


def upside_down(slices: Slices, stack: int) -> RigidPose:
    """Motions [K] that rotate one stack by 180 degrees about the centre of the head."""
    middle = slices.planes.pixel_world_mm(slices.pixel_index).mean(0)
    by = turned_about(middle, np.array([np.pi, 0, 0]), np.array([3.0, -2, 4]))
    return stack_moved(RigidPose.identity(len(slices)), slices, stack, by)


def jerked(slices: Slices, stack: int, by: RigidPose) -> tuple[RigidPose, np.ndarray]:
    """Motions [K] that differ in the second half in time (interleave 2) of one stack, and the slices of that half."""
    late = (slices.stack_id == stack) & (slices.slice_index % 2 == 1)
    motion = RigidPose.identity(len(slices))
    after = by @ motion
    return RigidPose(
        np.where(late[:, None, None], after.rotation, motion.rotation),
        np.where(late[:, None], after.translation_mm, motion.translation_mm),
    ), late


def test_another_frame_is_taken_out_and_strays_do_not_tilt_it(moving: Moving) -> None:
    slices, truth = moving.slices, moving.truth
    elsewhere = turned_about(np.zeros(3), np.array([2.0, 0.5, -1.0]), np.array([60.0, 20, -50])) @ truth
    stray = slices_disturbed(slices.with_motion(elsewhere), 30.0, 25.0).world_from_header()
    few = np.arange(len(slices)) % 6 == 0
    other = RigidPose(
        np.where(few[:, None, None], stray.rotation, elsewhere.rotation),
        np.where(few[:, None], stray.translation_mm, elsewhere.translation_mm),
    )
    back = aligned_to(slices, truth, other)
    distance = np.array(
        [head_distance_mm(back.take([k]), truth.take([k]), np.zeros(3))[0, 0] for k in range(len(slices))]
    )
    assert np.median(distance[~few]) < 1
    # relative motions are unchanged
    np.testing.assert_allclose(
        (back.inverse().take([0]) @ back.take([7])).rotation,
        (other.inverse().take([0]) @ other.take([7])).rotation,
        atol=1e-9,
    )


def test_half_a_stack_is_placed_again_after_a_jerk(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    """A misplaced segment is corrected without knowing which segment is wrong."""
    slices, _ = still_slices
    by = turned_about(np.zeros(3), np.deg2rad([0, 12, 8]), np.array([4.0, 3, -5]))
    motion, late = jerked(slices, 1, by)
    volume, grid = volume_without(slices.with_motion(motion), 1, 2.4)
    own = motion.take(samples[1].rows)
    placed = refine_placement(
        samples[1], own, volume, grid, rotation_deg=2.0, translation_mm=1.0, rng=np.random.default_rng(0)
    )
    away = np.array(
        [head_distance_mm(placed.motion.take([k]), RigidPose.identity(1), np.zeros(3))[0, 0] for k in range(len(own))]
    )
    assert np.median(away) < 2
    assert away[late[samples[1].rows]].mean() < 3
    proposed = refine_placement(
        samples[1],
        own,
        volume,
        grid,
        rotation_deg=40.0,
        translation_mm=30.0,
        rng=np.random.default_rng(0),
        proposals=RigidPose.identity(1),
    )
    assert (proposed.motion.translation_mm == 0).all(1).mean() > 0.8


def test_a_rigid_stack_gets_one_motion_and_one_with_a_jerk_keeps_two(head: Phantom) -> None:
    jerk = MotionLevel(n_jerks=1, jerk_deg=10.0, jerk_mm=6.0)
    slices, truth = as_slices(simulated(head, [STILL, jerk, STILL], seed=2))
    _, sizes = np.unique(truth.take(slices.stack_id == 1).translation_mm.round(6), axis=0, return_counts=True)
    assert len(sizes) == 2
    assert sizes.min() >= 4
    samples = StackSamples.of_all(slices)
    found = collapse_to_rigid(slices, samples, truth, [2, 2, 2])
    np.testing.assert_array_equal(found.rotation[samples[1].rows], truth.rotation[samples[1].rows])
    for stack in (0, 2):
        own = found.take(samples[stack].rows)
        np.testing.assert_allclose(own.rotation, own.rotation[:1].repeat(len(own), 0), atol=1e-9)
        np.testing.assert_allclose(own.translation_mm, own.translation_mm[:1].repeat(len(own), 0), atol=1e-6)
    assert np.median(pixel_errors_mm(slices.with_motion(found), truth)) < 0.5


def test_segments_need_a_gain_and_a_volume_that_shows_the_head(head: Phantom) -> None:
    jerk = MotionLevel(n_jerks=1, jerk_deg=10.0, jerk_mm=6.0)
    slices, truth = as_slices(simulated(head, [STILL, jerk, STILL], seed=2))
    sample = StackSamples.of_all(slices)[1]
    own = truth.take(sample.rows)
    volume, grid = volume_without(slices.with_motion(truth), sample.stack, 2.4)
    in_segments = predict(sample, own, volume, grid, 2)
    one, is_rigid = rigid_or_segments(slices, sample, own, 2, volume, grid, min_cost_gain=np.inf)
    gain = predict(sample, one, volume, grid, 2).cost - in_segments.cost
    assert is_rigid
    assert gain > MIN_SINGLE_GAIN_PER_SAMPLE * sample.pixels.n_samples  # far more than the threshold of a single stack
    for limits, expected in (
        ({"min_cost_gain": 0.9 * gain}, False),
        ({"min_cost_gain": 1.1 * gain}, True),
        ({"min_correlation": in_segments.correlation - 0.01}, False),
        ({"min_correlation": in_segments.correlation + 0.01}, True),
    ):
        assert rigid_or_segments(slices, sample, own, 2, volume, grid, **limits)[1] is expected, limits


def test_segments_that_fit_noise_collapse_to_one_motion(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    slices, truth = still_slices
    motion = slices_disturbed(slices, 0.7, 0.4).world_from_header()
    found = collapse_to_rigid(slices, samples, motion, [1, 1, 1])
    assert segments_of(samples, found)[0] == [1, 1, 1]
    before, after = (pixel_errors_mm(slices.with_motion(m), truth) for m in (motion, found))
    assert after.mean() < 0.7 * before.mean()


def test_a_stack_that_starts_upside_down_comes_back(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    slices, truth = still_slices
    start = upside_down(slices, 1)
    assert np.median(pixel_errors_mm(slices.with_motion(start), truth)[(slices.stack_id == 1)[slices.pixel_plane]]) > 20
    found, placements = refine_segments(slices, samples, start, [], np.random.default_rng(0))
    error = pixel_errors_mm(slices.with_motion(found), truth)
    assert np.median(error) < 1.5
    assert np.quantile(error, 0.9) < 4
    assert len(placements) == 3
    assert held_out_score(slices, samples, found).cost < held_out_score(slices, samples, start).cost - 100


def test_severe_motion_is_undone(moving: Moving) -> None:
    """Headers are 16 mm off, each stack has four jerks of 15 degrees, and some slices have dropouts."""
    before = pixel_errors_mm(moving.slices, moving.truth)
    after = pixel_errors_mm(moving.estimate.slices, moving.truth)
    assert np.median(before) > 15
    assert np.median(after) < 1.5
    assert np.quantile(after, 0.75) < 3
