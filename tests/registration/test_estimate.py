"""The whole of registration on a small synthetic head."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.motion import LEVELS
from data_synth.phantom import Phantom
from data_synth.simulator import SimulatedStack
from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.geometry import RigidPose
from g3r.registration import RegistrationSettings, register
from g3r.registration.atlas_frame import centred_on_headers
from g3r.registration.motion_shear import motion_shear
from g3r.registration.slice_rounds import ROUNDS_AFTER_SEARCH
from tests.registration.moving_heads import Moving, as_slices, pixel_errors_mm, sheared, simulated

OFF = RegistrationSettings(template=False, network=False, stacks=False, segments=False, n_rounds=0, finest_voxel_mm=1.8)


def test_the_whole_estimate_on_a_moving_head(moving: Moving) -> None:
    """With walks, jerks and stack offsets, poses are recovered to a fraction of the header's error."""
    slices, estimate = moving.slices, moving.estimate
    before, after = pixel_errors_mm(slices, moving.truth), pixel_errors_mm(estimate.slices, moving.truth)
    assert before.mean() > 4
    assert np.median(after) < 1.2
    assert after.mean() < 0.4 * before.mean()
    assert moving.progress == [*((n, 4) for n in range(4)), (4, 4)]
    assert len(estimate.history) in [4 + n * ROUNDS_AFTER_SEARCH for n in range(4)]
    for array in (estimate.gain, estimate.weight, estimate.ncc):
        assert array.shape == (len(slices),)
        assert np.isfinite(array).all()
    assert np.median(estimate.ncc) > 0.9
    # at the poles, the blur of the volume looks like a gain
    assert np.quantile(np.abs(np.log(estimate.gain)), 0.8) < 0.1
    np.testing.assert_array_equal(estimate.slices.value, slices.value)  # bias correction is for registration only


def test_the_whole_estimate_says_how_it_was_found(moving: Moving) -> None:
    estimate = moving.estimate
    assert set(estimate.initialisations) == {"headers", "template", "stacks"}
    sums = {name: sum(values) for name, values in estimate.initialisations.items()}
    assert sums[estimate.initialisation] > sums["headers"]
    assert estimate.held_out is not None
    assert len(estimate.held_out) == len(estimate.interleave) == len(estimate.n_segments) == 3
    assert min(estimate.held_out) > max(estimate.initialisations["headers"])
    assert estimate.interleave == [2, 2, 2]
    assert all(1 <= n <= 6 for n in estimate.n_segments)
    assert estimate.orientation is not None
    assert estimate.orientation.weeks in (24, 31)


def test_with_everything_off_slices_stay_at_their_headers(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still)
    estimate = register(slices, OFF)
    np.testing.assert_allclose(estimate.slices.planes.center_mm, slices.planes.center_mm, atol=1e-9)
    assert (estimate.gain == 1).all()
    assert np.median(estimate.ncc) > 0.9
    assert estimate.initialisation == "headers"
    assert set(estimate.initialisations) == {"headers"}
    assert estimate.orientation is None
    assert estimate.n_segments == [1, 1, 1]


def test_the_finest_voxel_follows_what_a_pixel_covers(still: list[SimulatedStack]) -> None:
    """In a volume with smaller voxels each slice would be registered to itself."""
    slices, _ = as_slices(still)
    last = [
        register(slices, replace(OFF, n_rounds=2, finest_voxel_mm=mm, finest_voxel_pixels=0.8)).history[-1]["voxel_mm"]
        for mm in (0.5, 3.0)
    ]
    assert last == pytest.approx([0.8 * slices.typical_pixel_mm, 3.0])


def test_a_single_stack_is_left_as_the_header_says(still: list[SimulatedStack]) -> None:
    slices, _ = as_slices(still[:1])
    estimate = register(slices, RegistrationSettings())
    np.testing.assert_allclose(estimate.slices.planes.center_mm, slices.planes.center_mm, atol=1e-9)
    assert estimate.held_out is None
    assert estimate.initialisations == {}
    assert estimate.history == []


@pytest.mark.parametrize(("n_slices", "layer"), [(1, "template"), (2, "segments")])
def test_stacks_of_one_or_two_slices(
    still: list[SimulatedStack], template: AtlasTemplate, n_slices: int, layer: str
) -> None:
    """Too few slices to register well, but no error."""
    slices, _ = as_slices(still)
    rows = np.concatenate([np.flatnonzero(slices.stack_id == s)[6 : 6 + n_slices] for s in (1, 2)])
    mixed = slices.take(np.concatenate([np.flatnonzero(slices.stack_id == 0), rows]))
    for subject in (mixed, slices.take(rows), slices.take(rows[:n_slices])):
        settings = replace(OFF, n_rounds=1, **{layer: True})
        estimate = register(subject, settings, template=template)
        assert np.isfinite(estimate.slices.planes.center_mm).all()
        assert np.isfinite(estimate.ncc).all()
        assert len(estimate.n_segments) == subject.n_stacks


def test_proposals_are_initialisations_like_the_others(moving: Moving) -> None:
    """True proposed poses are chosen; wrong ones, and those of a switched-off network, are not."""
    proposals = {"oracle": moving.truth, "astray": RigidPose.identity(len(moving.slices))}
    settings = replace(OFF, network=True)
    estimate = register(moving.slices, settings, proposals=proposals)
    assert estimate.initialisation == "oracle"
    # two of the three stacks are almost parallel, so a small open shear is removed
    assert np.median(pixel_errors_mm(estimate.slices, moving.truth)) < 0.01
    deaf = register(moving.slices, replace(settings, network=False), proposals=proposals)
    assert set(deaf.initialisations) == {"headers"}


def test_the_common_motion_of_all_slices_is_removed(still: list[SimulatedStack]) -> None:
    """Poses are determined only up to the common motion, and a few slices astray do not tilt it."""
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


def test_poses_of_two_stacks_do_not_keep_a_shear_that_motion_is_not_likely_to_have(head: Phantom) -> None:
    slices, truth = as_slices(simulated(head, LEVELS["mild"], n_stacks=2, seed=4))
    true = slices.with_motion(truth)
    astray = sheared(true, 0.03)
    estimate = register(slices, replace(OFF, network=True), proposals={"network": astray.world_from_header()})
    assert estimate.initialisation == "network"
    amounts = []
    for found in (true, astray, estimate.slices):
        shear = motion_shear(found, [2, 2])
        assert shear is not None
        amounts.append(abs(shear.amount))
    of_truth, of_proposal, of_estimate = amounts
    assert of_truth < 0.2 * of_proposal
    assert of_estimate < 0.6 * of_proposal


def test_a_dark_slice_of_a_stack_that_did_not_move_counts_for_little(still: list[SimulatedStack]) -> None:
    """Its stack keeps the poses of its header, but not a weight of 1 for each of its slices."""
    slices, _ = as_slices(still)
    of_stack = np.flatnonzero(slices.stack_id == 1)
    dark = int(of_stack[len(of_stack) // 2])
    factor = np.where(slices.planes.plane_id() == dark, 0.05, 1.0).astype(np.float32)
    estimate = register(replace(slices, value=slices.value * factor), replace(OFF, n_rounds=4))
    np.testing.assert_allclose(estimate.slices.world_from_header().rotvec_rad()[of_stack], 0, atol=1e-9)  # it is rigid
    assert estimate.weight[dark] < 0.2
    assert estimate.gain[dark] < 0.3
    others = np.delete(of_stack, len(of_stack) // 2)
    assert (estimate.weight[others] == 1).mean() > 0.8
    assert (estimate.gain[others] == 1).mean() > 0.8
