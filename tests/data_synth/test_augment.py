"""Augmentation of heads: the result is still a head, and depends only on the generator."""

import numpy as np
import pytest
import torch

pytest.importorskip("torchio")

from data_synth.atlas import TruthVolume
from data_synth.augment import augmentation, augmented


def test_augmentation_keeps_a_head(head: TruthVolume) -> None:
    transform = augmentation()
    for seed in range(4):
        varied = augmented(head, transform, np.random.default_rng(seed))
        torch.rand(5)  # the global generator has no effect
        again = augmented(head, transform, np.random.default_rng(seed))
        np.testing.assert_array_equal(varied.data, again.data)
        assert varied.data.dtype == np.float32
        assert np.isfinite(varied.data).all()
        assert (varied.data[~varied.mask] == 0).all()
        assert abs(np.percentile(varied.data[varied.mask], 99.5) - 1) < 1e-3
        assert 0.6 < varied.mask.sum() / head.mask.sum() < 1.5
