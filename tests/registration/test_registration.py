"""Registration on a small synthetic head: stacks, slices, the whole of it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from data_synth.simulator import SimulatedStack
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import slice_weights
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration import RegistrationSettings, register
from g3r.registration.atlas_frame import centred_on_headers
from g3r.registration.normal_equations import SliceModel
from g3r.registration.slice_registration import register_slices, try_neighbours
from g3r.registration.stack_registration import register_stacks, self_consistency
from tests.registration.moving_heads import Moving, as_slices, pixel_errors_mm, simulated, slices_disturbed

OFF = RegistrationSettings(template=False, network=False, stacks=False, segments=False, n_rounds=0, finest_voxel_mm=1.8)


@pytest.mark.parametrize("seed", [0, 1])
def test_stacks_come_together_from_15_degrees_and_5_mm(still: list[SimulatedStack], seed: int):
    slices, truth = as_slices(still)
    rng = np.random.default_rng(seed)
    axis, direction = rng.normal(size=(2, 3))
    motion = RigidPose.from_rotvec(
        [np.deg2rad(15) * axis / np.linalg.norm(axis)], [5 * direction / np.linalg.norm(direction)]
    )
    moving = slices.stack_id == 1
    moved = slices.planes.moved(motion)
    slices = slices.with_pose(
        RigidPose(
            np.where(moving[:, None, None], moved.rotation, slices.planes.rotation),
            np.where(moving[:, None], moved.center_mm, slices.planes.center_mm),
        )
    )
    before = pixel_errors_mm(slices, truth).mean()
    registered, agreement = register_stacks(slices)
    after = pixel_errors_mm(registered, truth).mean()
    assert before > 1.5
    assert after < 1.0
    assert len(agreement) == 3
    assert max(agreement) == 1.0
    assert min(agreement) > 0.4  # volumes of the search are blurred


def test_one_stack_is_left_where_it_is(still: list[SimulatedStack]):
    slices, _ = as_slices(still[:1])
    registered, agreement = register_stacks(slices)
    assert registered is slices
    assert agreement == [1.0]


def test_self_consistency_is_lower_with_motion(head: Phantom, still: list[SimulatedStack]):
    moving, _ = as_slices(simulated(head, MotionLevel(walk_deg=3.0, walk_mm=2.0)))
    lying, _ = as_slices(still)
    for stack in range(3):
        assert self_consistency(lying.take(lying.stack_id == stack)) > self_consistency(
            moving.take(moving.stack_id == stack)
        )


def true_volume(slices: Slices, voxel_mm: float = 1.5) -> tuple[np.ndarray, VolumeGrid]:
    grid = grid_around(slices, voxel_mm)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    weight = np.ones(len(slices.pixel_index), np.float32)
    return solve_volume(operator, slices.masked_value, weight, n_iterations=15), grid


def test_a_volume_explains_its_slices_and_more_steps_explain_more(still: list[SimulatedStack]):
    slices, _ = as_slices(still)
    grid = grid_around(slices, 1.5)
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    weight = np.ones(len(slices.pixel_index), np.float32)
    errors = []
    for n in (1, 4, 16):
        volume = solve_volume(operator, slices.masked_value, weight, n_iterations=n)
        errors.append(float(np.square(operator.forward(volume) - slices.masked_value).mean() ** 0.5))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.05
    again = solve_volume(operator, slices.masked_value, weight, start=volume, n_iterations=2)
    assert np.abs(again - volume).max() < 0.2


def test_slices_find_back_to_a_volume(still: list[SimulatedStack]):
    slices, truth = as_slices(still)
    volume, grid = true_volume(slices)
    start = slices_disturbed(slices, 2.0, 1.2)
    gain = np.exp(np.random.default_rng(1).normal(0, 0.1, len(slices)))
    dark = replace(start, value=(start.value * np.repeat(gain, np.diff(start.planes.offset))).astype(np.float32))
    model = SliceModel(dark, volume, grid)
    found, found_gain, fit = register_slices(model, dark, np.ones(len(slices)), n_steps=15, width=0.08)
    before, after = pixel_errors_mm(start, truth), pixel_errors_mm(found, truth)
    assert np.median(after) < 0.3 * np.median(before)
    assert after.mean() < 0.5 * before.mean()
    big = fit.moments[:, 0] > 100
    ratio = np.log(found_gain / gain)[big]
    assert np.abs(ratio - np.median(ratio)).max() < 0.06
    assert fit.ncc[big].min() > 0.9


def test_registration_never_makes_the_fit_worse(still: list[SimulatedStack]):
    slices, _ = as_slices(still)
    volume, grid = true_volume(slices)
    start = slices_disturbed(slices, 6.0, 4.0)
    model = SliceModel(start, volume, grid)
    ones = np.ones(len(slices))
    before = model.evaluate(start.planes, ones, 0.1).loss
    _, _, fit = register_slices(model, start, ones, n_steps=6, width=0.1)
    assert fit.loss.mean() < before.mean()
    assert np.isfinite(fit.hessian).all()


def test_a_slice_that_lost_its_way_takes_its_neighbours_place(still: list[SimulatedStack]):
    slices, truth = as_slices(still)
    volume, grid = true_volume(slices)
    lost = int(np.flatnonzero(slices.stack_id == 0)[len(np.flatnonzero(slices.stack_id == 0)) // 2])
    center = slices.planes.center_mm.copy()
    center[lost] += [9.0, -7, 6]
    astray = slices.with_pose(RigidPose(slices.planes.rotation, center))
    model = SliceModel(astray, volume, grid)
    found, n_moved = try_neighbours(model, astray, np.ones(len(slices)), width=0.1)
    assert n_moved >= 1
    np.testing.assert_allclose(found.planes.center_mm[lost], slices.planes.center_mm[lost], atol=1e-6)
    assert pixel_errors_mm(found, truth).max() < 1.0


def test_the_whole_estimate_on_a_moving_head(moving: Moving):
    """Walks, jerks and stack offsets: the poses come back to a fraction of the header's error."""
    slices, estimate = moving.slices, moving.estimate
    before, after = pixel_errors_mm(slices, moving.truth), pixel_errors_mm(estimate.slices, moving.truth)
    assert before.mean() > 4
    assert np.median(after) < 1.2
    assert after.mean() < 0.4 * before.mean()
    assert moving.progress == [*((n, 4) for n in range(4)), (4, 4)]
    assert len(estimate.history) == 4
    for array in (estimate.gain, estimate.weight, estimate.ncc):
        assert array.shape == (len(slices),)
        assert np.isfinite(array).all()
    assert np.median(estimate.ncc) > 0.9
    # at the poles the volume's blur looks like a gain
    assert np.quantile(np.abs(np.log(estimate.gain)), 0.8) < 0.1
    np.testing.assert_array_equal(estimate.slices.value, slices.value)  # bias_corrected for registration alone


def test_the_whole_estimate_says_how_it_was_found(moving: Moving):
    estimate = moving.estimate
    assert set(estimate.initialisations) == {"headers", "template", "stacks"}
    sums = {name: sum(values) for name, values in estimate.initialisations.items()}
    assert sums[estimate.initialisation] > sums["headers"]
    assert len(estimate.held_out) == len(estimate.interleave) == len(estimate.n_segments) == 3
    assert min(estimate.held_out) > max(estimate.initialisations["headers"])
    assert estimate.interleave == [2, 2, 2]
    assert all(1 <= n <= 6 for n in estimate.n_segments)
    assert estimate.orientation is not None
    assert estimate.orientation.weeks in (24, 31)


def test_with_everything_off_slices_stay_at_their_headers(still: list[SimulatedStack]):
    slices, _ = as_slices(still)
    estimate = register(slices, OFF)
    np.testing.assert_allclose(estimate.slices.planes.center_mm, slices.planes.center_mm, atol=1e-9)
    assert (estimate.gain == 1).all()
    assert np.median(estimate.ncc) > 0.9
    assert estimate.initialisation == "headers"
    assert set(estimate.initialisations) == {"headers"}
    assert estimate.orientation is None
    assert estimate.n_segments == [1, 1, 1]


def test_a_single_stack_is_left_as_the_header_says(still: list[SimulatedStack]):
    slices, _ = as_slices(still[:1])
    estimate = register(slices, RegistrationSettings())
    np.testing.assert_allclose(estimate.slices.planes.center_mm, slices.planes.center_mm, atol=1e-9)
    assert estimate.held_out is None
    assert estimate.initialisations == {}
    assert estimate.history == []


@pytest.mark.parametrize(("n_slices", "layer"), [(1, "template"), (2, "segments")])
def test_stacks_of_one_or_two_slices(still: list[SimulatedStack], template: AtlasTemplate, n_slices: int, layer: str):
    """Too few to register well, but no reason to break down."""
    slices, _ = as_slices(still)
    rows = np.concatenate([np.flatnonzero(slices.stack_id == s)[6 : 6 + n_slices] for s in (1, 2)])
    mixed = slices.take(np.concatenate([np.flatnonzero(slices.stack_id == 0), rows]))
    for subject in (mixed, slices.take(rows), slices.take(rows[:n_slices])):
        settings = replace(OFF, n_rounds=1, **{layer: True})
        estimate = register(subject, settings, template=template)
        assert np.isfinite(estimate.slices.planes.center_mm).all()
        assert np.isfinite(estimate.ncc).all()
        assert len(estimate.n_segments) == len(np.unique(subject.stack_id))


def test_proposals_are_rivals_like_the_others(moving: Moving):
    """True poses offered from outside are taken; wrong ones are not, and those of a switched-off network."""
    proposals = {"oracle": moving.truth, "astray": RigidPose.identity(len(moving.slices))}
    settings = replace(OFF, network=True)
    estimate = register(moving.slices, settings, proposals=proposals)
    assert estimate.initialisation == "oracle"
    assert np.median(pixel_errors_mm(estimate.slices, moving.truth)) < 1e-6
    deaf = register(moving.slices, replace(settings, network=False), proposals=proposals)
    assert set(deaf.initialisations) == {"headers"}


def test_the_motion_that_all_slices_share_is_taken_out(still: list[SimulatedStack]):
    """Poses are only determined up to it; a few slices that went astray do not tilt it."""
    slices, _ = as_slices(still)
    motion = RigidPose.from_rotvec([[0.2, -0.3, 0.1]], [[8.0, -5, 12]])
    moved = slices.planes.moved(motion)
    center = moved.center_mm.copy()
    center[::10] += [0.0, 25, -15]
    found = centred_on_headers(slices.with_pose(RigidPose(moved.rotation, center)))
    usual = np.arange(len(slices)) % 10 != 0
    distance = np.linalg.norm(found.planes.center_mm - slices.planes.center_mm, axis=1)
    assert distance[usual].max() < 0.2
    assert distance[~usual].min() > 20


def test_slice_weights_are_smooth_and_never_zero():
    rng = np.random.default_rng(0)
    usual = rng.normal(1.0, 0.1, 200).clip(0.1)
    previous = None
    for bad in np.linspace(0.9, 5, 1500):
        weight = slice_weights(np.append(usual, bad))
        assert weight.min() > 0
        assert weight.max() == 1.0
        if previous is not None:
            assert weight[-1] <= previous + 1e-12
            assert previous - weight[-1] < 0.02
        previous = weight[-1]
    assert previous <= 2e-3
    assert np.median(slice_weights(usual)) == 1.0
    assert (slice_weights(np.zeros(5)) == 1).all()
    assert (slice_weights(np.full(5, 3.3)) == 1).all()
    for a, b in itertools.pairwise((1e-6, 1.0, 1e6)):  # a pure number of the loss
        np.testing.assert_allclose(slice_weights(usual * a), slice_weights(usual * b), rtol=1e-3)
