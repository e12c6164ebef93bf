"""Registration on a small synthetic head: stacks, slices, the whole of it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom, fetal_brain_phantom
from data_synth.simulator import SimulatedStack, orthogonal_settings, simulate_stacks
from g3r.acquisition.planes import Slices, slices_from_stacks
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import fit_rigid
from g3r.motion import MotionSettings, estimate_motion
from g3r.motion.estimate import centred_on_headers, slice_weights
from g3r.motion.normal_equations import SliceModel
from g3r.motion.slice_registration import register_slices, try_neighbours
from g3r.motion.stack_registration import register_stacks, self_consistency
from g3r.motion.volume import grid_around, solve_volume


@pytest.fixture(scope="module")
def head() -> Phantom:
    return fetal_brain_phantom(24, 1.2)


@pytest.fixture(scope="module")
def still(head: Phantom) -> list[SimulatedStack]:
    """Three stacks of a head that lies still, clean."""
    return simulated(head)


def simulated(head: Phantom, **motion: float) -> list[SimulatedStack]:
    settings = orthogonal_settings(
        3, resolution_mm=1.5, thickness_mm=4.0, snr=60.0, bias=0.0, gain_deviation=0.0
    )
    settings = [replace(one, motion=MotionLevel(**motion)) for one in settings]
    return simulate_stacks(head.t2, head.mask, head.affine, settings, np.random.default_rng(0))


def as_slices(stacks: list[SimulatedStack]) -> tuple[Slices, RigidPose]:
    """Slices with intensities of order one, and where a point by the header truly lies."""
    slices = slices_from_stacks([one.stack for one in stacks])
    slices = slices.scaled(1 / float(np.percentile(slices.masked_value, 99)))
    poses = [one.true_pose for one in stacks]
    chosen = [
        (poses[s].rotation[k], poses[s].translation_mm[k])
        for s, k in zip(slices.stack_id, slices.slice_index, strict=True)
    ]
    return slices, RigidPose(np.array([c[0] for c in chosen]), np.array([c[1] for c in chosen]))


def pixel_errors_mm(slices: Slices, truth: RigidPose) -> np.ndarray:
    """Distance of every masked pixel from its true place once one global motion is taken out [P']."""
    header = slices.planes.with_pose(slices.header_pose).pixel_world_mm(slices.pixel_index)
    plane = slices.pixel_plane
    true = np.einsum("pij,pj->pi", truth.rotation[plane], header) + truth.translation_mm[plane]
    found = slices.planes.pixel_world_mm(slices.pixel_index)
    return np.linalg.norm(fit_rigid(found, true).apply(found[None])[0] - true, axis=1)


def perturbed(slices: Slices, degrees: float, mm: float, seed: int = 0) -> Slices:
    """Every slice turned and shifted at random about its own middle."""
    rng = np.random.default_rng(seed)
    turn = RigidPose.from_rotvec(
        np.deg2rad(rng.normal(0, degrees, (len(slices), 3))), np.zeros((len(slices), 3))
    )
    pose = slices.planes.pose @ turn
    return slices.with_pose(
        RigidPose(pose.rotation, pose.translation_mm + rng.normal(0, mm, (len(slices), 3)))
    )


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
    assert before > 2
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
    moving, _ = as_slices(simulated(head, walk_deg=3.0, walk_mm=2.0))
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
    start = perturbed(slices, 2.0, 1.2)
    gain = np.exp(np.random.default_rng(1).normal(0, 0.1, len(slices)))
    dark = replace(
        start, value=(start.value * np.repeat(gain, np.diff(start.planes.offset))).astype(np.float32)
    )
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
    start = perturbed(slices, 6.0, 4.0)
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


def test_the_whole_estimate_on_a_moving_head(head: Phantom):
    """Walks, jerks and stack offsets: the poses come back to a fraction of the header's error."""
    stacks = simulated(
        head, walk_deg=0.5, walk_mm=0.3, n_jerks=1, jerk_deg=4.0, jerk_mm=2.0, offset_deg=8.0, offset_mm=4.0
    )
    slices, truth = as_slices(stacks)
    before = pixel_errors_mm(slices, truth)
    calls: list[tuple[int, int]] = []
    settings = MotionSettings(n_rounds=6, finest_voxel_mm=1.8)
    estimate = estimate_motion(slices, settings, lambda done, total: calls.append((done, total)))
    after = pixel_errors_mm(estimate.slices, truth)
    assert before.mean() > 4
    assert np.median(after) < 1.2
    assert after.mean() < 0.4 * before.mean()
    assert calls == [*((n, 6) for n in range(6)), (6, 6)]
    assert len(estimate.history) == 6
    for array in (estimate.gain, estimate.weight, estimate.ncc):
        assert array.shape == (len(slices),)
        assert np.isfinite(array).all()
    assert np.median(estimate.ncc) > 0.9
    # at the poles the volume's blur looks like a gain
    assert np.quantile(np.abs(np.log(estimate.gain)), 0.8) < 0.1


def test_no_rounds_leave_slices_at_their_headers(still: list[SimulatedStack]):
    slices, _ = as_slices(still)
    estimate = estimate_motion(slices, MotionSettings(stacks=False, n_rounds=0))
    np.testing.assert_allclose(estimate.slices.planes.center_mm, slices.planes.center_mm, atol=1e-9)
    assert (estimate.gain == 1).all()
    assert np.median(estimate.ncc) > 0.9


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
