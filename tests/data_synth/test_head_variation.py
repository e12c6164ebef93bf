"""Varied heads: random shape and contrast in the same frame."""

import numpy as np
import pytest
from scipy.ndimage import center_of_mass

from data_synth.atlas import TruthVolume

pytest.importorskip("torchio")

from data_synth.head_variation import recurved, varied_head
from g3r.geometry import VolumeGrid


def test_still_in_the_atlas_frame(centred_head: TruthVolume, rng: np.random.Generator) -> None:
    varied = varied_head(centred_head, rng)
    grid = VolumeGrid(varied.data.shape, varied.affine)
    np.testing.assert_allclose(grid.world(center_of_mass(varied.mask)), 0, atol=1e-6)
    assert (varied.data[~varied.mask] == 0).all()
    assert varied.data.min() >= 0


def test_bent_by_millimetres_not_more(centred_head: TruthVolume, rng: np.random.Generator) -> None:
    overlaps = []
    for _ in range(5):
        varied = varied_head(centred_head, rng)
        both = (varied.mask & centred_head.mask).sum()
        overlaps.append(2 * both / (varied.mask.sum() + centred_head.mask.sum()))
        assert 0.8 < varied.mask.sum() / centred_head.mask.sum() < 1.25
    assert 0.85 < np.mean(overlaps) < 0.98


def test_intensities_follow_a_curve(centred_head: TruthVolume, rng: np.random.Generator) -> None:
    """Equal intensities remain equal."""
    varied = recurved(centred_head, rng)
    order = np.argsort(centred_head.data[centred_head.mask])
    before, after = centred_head.data[centred_head.mask][order], varied.data[centred_head.mask][order]
    same = np.diff(before) == 0
    assert np.abs(np.diff(after)[same]).max() < 1e-5
    assert np.abs(after - before).max() > 0.02
