"""Held-out scores: true poses predict the other stacks best."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, Slices
from g3r.acquisition.psf import psf_variance_mm2
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration import held_out
from g3r.registration.held_out import (
    fine_held_out_correlations,
    held_out_score,
    held_out_scores,
    predict,
    volume_without,
)
from g3r.registration.similarity import StackSamples
from tests.registration.moving_heads import Moving, slices_disturbed, stack_moved, turned_about


def test_true_poses_predict_better_than_wrong_ones(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    """The cost grows with the error, and the wrong stack has the lowest correlation."""
    slices, truth = still_slices
    right = held_out_score(slices, samples, truth)
    assert min(p.correlation for p in right.prediction) > 0.75
    previous = right.cost
    for degrees, mm in ((3.0, 1.5), (8.0, 5.0), (25.0, 10.0)):
        by = turned_about(np.zeros(3), np.deg2rad([degrees, 0, 0]), np.array([0, mm, 0]))
        wrong = held_out_score(slices, samples, stack_moved(truth, slices, 1, by))
        assert wrong.cost > previous + 20
        assert np.argmin([p.correlation for p in wrong.prediction]) == 1
        previous = wrong.cost


def test_a_score_has_a_prediction_for_every_stack_and_slice(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    slices, truth = still_slices
    scores = held_out_score(slices, samples, truth)
    assert len(scores.prediction) == 3
    for stack, one in enumerate(scores.prediction):
        assert one.moments.shape == ((slices.stack_id == stack).sum(), 6)
    assert scores.cost == pytest.approx(sum(p.cost for p in scores.prediction))


def test_a_few_slices_that_went_astray_do_not_count_in_the_agreement(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    slices, truth = still_slices
    rows = samples[1].rows
    middle = len(rows) // 2
    astray = rows[middle : middle + max(1, len(rows) // 8)]
    far = turned_about(np.zeros(3), np.deg2rad([60, 0, 0]), np.array([0, 30, 0]))
    score = held_out_score(slices, samples, truth.with_rows(astray, far @ truth.take(astray)))
    weight = np.ones(len(slices))
    without = score.agreements(samples, weight)
    assert without == score.correlations
    weight[astray] = 0.1
    assert score.agreements(samples, weight)[1] > without[1] + 0.01
    # if many slices would not count, all are used
    weight[rows[::2]] = 0.1
    assert score.agreements(samples, weight)[1] == without[1]


def test_a_slice_whose_thinned_pixels_are_all_black_does_not_decide(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    """What the others show there is faint, and differs between placements by next to nothing."""
    slices, truth = still_slices
    sample = samples[1]
    value = sample.pixels.value.copy()
    value[sample.pixels.start[0] : sample.pixels.start[1]] = 0
    blank = replace(sample, pixels=replace(sample.pixels, value=value))
    volume, grid = volume_without(slices, 1, 3.2)
    own = truth.take(sample.rows)
    costs = [predict(blank, own, np.maximum(volume, faint), grid, 2).cost for faint in (1e-3, 1e-2)]
    assert abs(costs[1] - costs[0]) < 10


def test_poses_pay_a_penalty_for_their_movements(
    still_slices: tuple[Slices, RigidPose], samples: list[StackSamples]
) -> None:
    slices, truth = still_slices
    moving_poses = slices_disturbed(slices, 0.1, 0.05).world_from_header()
    assert held_out_score(slices, samples, moving_poses).cost > held_out_score(slices, samples, truth).cost + 5 * len(
        slices
    )


def test_the_true_initialisation_has_the_lowest_cost(moving: Moving) -> None:
    slices, truth = moving.slices, moving.truth
    initialisations = {
        "headers": RigidPose.identity(len(slices)),
        "truth": truth,
        "nearly": slices_disturbed(slices.with_motion(truth), 4.0, 3.0).world_from_header(),
    }
    scores = held_out_scores(slices, StackSamples.of_all(slices), initialisations)
    assert set(scores) == set(initialisations)
    assert scores["truth"].cost < min(scores["nearly"].cost, scores["headers"].cost)


def test_a_slice_does_not_predict_itself(still_slices: tuple[Slices, RigidPose]) -> None:
    """A volume made without a stack does not depend on that stack."""
    slices, _ = still_slices
    volume, grid = volume_without(slices, 1, 3.2)
    brighter = slices.value.copy()
    own = (slices.stack_id == 1)[slices.planes.plane_id()]
    brighter[own] *= 3
    again, again_grid = volume_without(replace(slices, value=brighter), 1, 3.2)
    np.testing.assert_array_equal(volume, again)
    np.testing.assert_array_equal(grid.affine, again_grid.affine)
    everything, _ = volume_without(replace(slices, value=brighter), -1, 3.2)
    assert everything.max() > 1.3 * volume.max()


def test_the_fine_correlation_asks_only_where_others_saw(still_slices: tuple[Slices, RigidPose]) -> None:
    """Zeros in the part unseen by two of three stacks are no evidence: closing the hole scores no better than truth."""
    slices, _ = still_slices
    place = np.abs(slices.slice_index - np.median(slices.slice_index))
    holed = slices.take((slices.stack_id == 0) | (place > 2))
    center = holed.planes.center_mm.copy()
    for stack in (1, 2):
        rows = np.flatnonzero(holed.stack_id == stack)
        side = np.sign(holed.slice_index[rows] - np.median(slices.slice_index))
        center[rows] -= 1.5 * side[:, None] * holed.planes.rotation[rows, :, 2]
    closed = holed.with_pose(RigidPose(holed.planes.rotation, center))
    whole, right, wrong = (
        float(np.mean(fine_held_out_correlations(one, np.ones(len(one))))) for one in (slices, holed, closed)
    )
    assert right > whole - 0.12
    assert right > wrong + 0.01


def test_a_stack_of_which_others_saw_nothing_correlates_by_zero(still_slices: tuple[Slices, RigidPose]) -> None:
    slices, _ = still_slices
    center = slices.planes.center_mm + np.array([0.0, 0.0, 500.0]) * (slices.stack_id == 2)[:, None]
    apart = slices.with_pose(RigidPose(slices.planes.rotation, center)).take(slices.stack_id != 1)
    assert fine_held_out_correlations(apart, np.ones(len(apart))) == [0.0, 0.0]


def test_wide_rectangular_masks_do_not_hide_columns() -> None:
    """Every 32nd of 256 x 256 pixels lies in 8 columns of all slices; true poses then predict each other badly."""
    grid = VolumeGrid.isotropic([-56] * 3, [56] * 3, 2.0)
    blobs = gaussian_filter(np.random.default_rng(0).normal(size=grid.shape), 2.0)
    volume = (1 + 0.3 * blobs / blobs.std()).astype(np.float32)
    turns = Rotation.from_rotvec(np.pi / 2 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])).as_matrix()
    stack_id = np.repeat(np.arange(3), 25)
    rotation = turns[stack_id]
    planes = Planes(
        rotation=rotation,
        center_mm=4.0 * (np.tile(np.arange(25), 3) - 12)[:, None] * rotation[:, :, 2],
        spacing_mm=np.full((75, 2), 0.4),
        shape=np.full((75, 2), 256),
        psf_var_mm2=np.tile(psf_variance_mm2([0.4, 0.4], 4.0), (75, 1)),
    )
    slices = Slices(
        planes=planes,
        value=VoxelOperator(planes, grid).forward(volume),
        mask=np.ones(planes.n_pixels, bool),
        stack_id=stack_id,
        slice_index=np.tile(np.arange(25), 3),
        thickness_mm=np.full(75, 4.0),
        header_pose=planes.pose,
    )
    score = held_out_score(slices, StackSamples.of_all(slices), RigidPose.identity(75))
    assert min(score.correlations) > 0.9


def test_the_profile_of_thin_slices_is_left_out_of_coarse_volumes(
    still_slices: tuple[Slices, RigidPose], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interpolation between voxels blurs more than a thin profile; the profile of thick slices is used."""
    slices, truth = still_slices
    posed = slices.with_motion(truth)

    def volumes(thickness_mm: float) -> list[np.ndarray]:
        variance = posed.planes.psf_var_mm2.copy()
        variance[:, 2] = (thickness_mm / 2.355) ** 2
        profiled = replace(posed, planes=replace(posed.planes, psf_var_mm2=variance))
        found = []
        for least in (held_out.THIN_VARIANCE, 0.0, np.inf):
            monkeypatch.setattr(held_out, "THIN_VARIANCE", least)
            found.append(volume_without(profiled, 0, 3.2)[0])
        monkeypatch.undo()
        return found

    chosen, with_profile, without = volumes(2.2)
    assert np.array_equal(chosen, without)
    assert np.corrcoef(with_profile.ravel(), without.ravel())[0, 1] > 0.99
    chosen, with_profile, without = volumes(4.0)
    assert np.array_equal(chosen, with_profile)
    assert not np.array_equal(chosen, without)
