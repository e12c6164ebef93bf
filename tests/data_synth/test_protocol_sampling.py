"""Random acquisition settings of stacks."""

import numpy as np

from data_synth.protocol_sampling import draw_settings


def test_draws_cover_what_protocols_do() -> None:
    drawn = [draw_settings("none", np.random.default_rng(seed)) for seed in range(400)]
    counts = np.bincount([len(one) for one in drawn], minlength=7)
    assert (counts[1:] > 0).all()
    assert counts[1] > 80
    gaps = np.array([one[0].gap_mm for one in drawn])
    thickness = np.array([one[0].thickness_mm for one in drawn])
    resolution = np.array([one[0].resolution_mm for one in drawn])
    assert (gaps > 0).any()
    assert (gaps < 0).any()
    assert (gaps == 0).any()
    assert thickness.min() >= 2
    assert thickness.max() > 4.5
    assert 0.5 <= resolution.min() < 0.6
    assert 1.2 < resolution.max() <= 1.3
    assert len(draw_settings("none", np.random.default_rng(0), n_stacks=5)) == 5
