"""Slices of a single stack are moved to the prior if it then explains them better."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration import prior_registration
from g3r.registration.prior_registration import register_to_prior, without_stretch
from tests.registration.moving_heads import STILL, as_slices, pixel_errors_mm, simulated


def test_slices_that_moved_come_nearer_to_a_good_prior(head: Phantom) -> None:
    slices, truth = as_slices(simulated(head, MotionLevel(walk_deg=1.2, walk_mm=0.8), n_stacks=1))
    bright = np.percentile(head.t2[head.mask], 99)
    prior = (gaussian_filter(head.t2 * head.mask, 0.8) / bright).astype(np.float32)
    grid = VolumeGrid(head.t2.shape, head.affine)
    found, gain, accepted = register_to_prior(slices, np.ones(len(slices)), prior, grid)
    assert accepted
    assert np.median(pixel_errors_mm(found, truth)) < 0.4 * np.median(pixel_errors_mm(slices, truth))
    assert gain.shape == (len(slices),)


def test_slices_in_line_stay_there_against_a_prior_that_says_nothing_new(head: Phantom) -> None:
    slices, _ = as_slices(simulated(head, STILL, n_stacks=1))
    grid = grid_around(slices, 1.5)
    coarse, _ = coarse_and_density(slices, grid)
    gain = np.full(len(slices), 1.05)
    found, same, accepted = register_to_prior(slices, gain, coarse, grid)
    assert not accepted
    assert found is slices
    assert same is gain


def test_a_stack_takes_its_length_from_its_header_and_not_from_the_prior(
    head: Phantom, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slightly longer prior volume pulls slices apart, which no other term would undo."""
    slices, _ = as_slices(simulated(head, STILL, n_stacks=1))
    normal = slices.header_pose.rotation[0, :, 2]
    axis = int(np.argmax(np.abs(normal)))
    affine = head.affine.copy()
    middle = affine[axis] @ [*(np.array(head.t2.shape) - 1) / 2, 1]
    affine[axis] *= 1.1
    affine[axis, 3] -= 0.1 * middle
    bright = np.percentile(head.t2[head.mask], 99)
    longer = (gaussian_filter(head.t2 * head.mask, 0.8) / bright).astype(np.float32)
    monkeypatch.setattr(prior_registration, "MIN_PRIOR_LOSS_REMOVED", -1.0)

    def stretch() -> float:
        found, _, _ = register_to_prior(slices, np.ones(len(slices)), longer, VolumeGrid(head.t2.shape, affine))
        n_pixels = np.bincount(slices.pixel_plane, minlength=len(slices))
        place = slices.header_pose.translation_mm @ normal
        moved = (found.planes.center_mm - slices.planes.center_mm) @ normal
        return float(np.polyfit(place, moved, 1, w=np.sqrt(n_pixels))[0])

    held = stretch()
    monkeypatch.setattr(prior_registration, "without_stretch", lambda before, after: after)
    assert stretch() > 0.02
    assert abs(held) < 0.003


def test_all_but_the_stretch_of_a_move_is_kept(head: Phantom, rng: np.random.Generator) -> None:
    slices, _ = as_slices(simulated(head, STILL, n_stacks=1))
    turn, shift = rng.normal(0, 0.02, (len(slices), 3)), rng.normal(0, 0.5, (len(slices), 3))
    n_pixels = np.bincount(slices.pixel_plane, minlength=len(slices))
    place = slices.header_pose.translation_mm @ slices.header_pose.rotation[0, :, 2]
    place = place - np.average(place, weights=n_pixels)
    kept = []
    for factor in (0.0, 0.1):
        whole = RigidPose.from_rotvec(turn, shift + np.outer(factor * place, [0, 0, 1]))
        found = without_stretch(slices, slices.with_pose(slices.planes.pose @ whole))
        kept.append(slices.planes.pose.inverse() @ found.planes.pose)
    assert np.allclose(kept[0].translation_mm, kept[1].translation_mm, atol=1e-9)
    assert np.allclose(kept[0].rotvec_rad(), turn, atol=1e-9)
    taken = shift - kept[0].translation_mm
    assert np.abs(taken[:, :2]).max() < 1e-9
    slope = np.polyfit(place, taken[:, 2], 1)
    assert np.allclose(taken[:, 2], np.polyval(slope, place), atol=1e-9)
    assert slope[0] == pytest.approx(np.polyfit(place, shift[:, 2], 1, w=np.sqrt(n_pixels))[0])
