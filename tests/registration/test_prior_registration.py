"""Slices of a single stack move towards the prior where that explains them better."""

import numpy as np
from scipy.ndimage import gaussian_filter

from data_synth.motion import MotionLevel
from data_synth.phantom import Phantom
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.geometry import VolumeGrid
from g3r.registration.prior_registration import register_to_prior
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
