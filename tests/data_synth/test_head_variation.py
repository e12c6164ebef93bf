"""Varied heads: another shape, other contrasts, the same frame."""

import numpy as np
import pytest
from scipy.ndimage import center_of_mass

from data_synth.head_variation import varied_head
from data_synth.heads import PhantomSubject, load_head
from g3r.geometry import VolumeGrid


@pytest.fixture(scope="module")
def head():
    return load_head(PhantomSubject("a", 28.0, 3), 2.5)


def test_still_in_the_atlas_frame(head, rng):
    varied = varied_head(head, rng)
    grid = VolumeGrid(varied.data.shape, varied.affine)
    np.testing.assert_allclose(grid.world(center_of_mass(varied.mask)), 0, atol=1e-6)
    assert (varied.data[~varied.mask] == 0).all()
    assert varied.data.min() >= 0


def test_bent_by_millimetres_not_more(head, rng):
    overlaps = []
    for _ in range(5):
        varied = varied_head(head, rng)
        both = (varied.mask & head.mask).sum()
        overlaps.append(2 * both / (varied.mask.sum() + head.mask.sum()))
        assert 0.8 < varied.mask.sum() / head.mask.sum() < 1.25
    assert 0.85 < np.mean(overlaps) < 0.98


def test_intensities_follow_a_curve(head):
    """With the bending switched off, equal intensities stay equal."""

    class OnlyCurve:
        def __init__(self):
            self.rng = np.random.default_rng(1)

        def normal(self, mean, deviation, size):
            values = self.rng.normal(mean, deviation, size)
            return np.zeros(size) if np.ndim(values) > 1 else values

    varied = varied_head(head, OnlyCurve())
    order = np.argsort(head.data[head.mask])
    before, after = head.data[head.mask][order], varied.data[head.mask][order]
    same = np.diff(before) == 0
    assert np.abs(np.diff(after)[same]).max() < 1e-5
    assert np.abs(after - before).max() > 0.02
