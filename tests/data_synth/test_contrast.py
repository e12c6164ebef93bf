"""Random contrasts of a labelled head."""

from dataclasses import replace

import numpy as np

from data_synth.atlas import TruthVolume
from data_synth.contrast import recoloured


def test_a_recoloured_head_keeps_its_tissues_apart(head: TruthVolume) -> None:
    assert head.labels is not None
    new = recoloured(head, np.random.default_rng(1))
    assert new.data.dtype == np.float32
    assert (new.data[~head.mask] == 0).all()
    assert new.data.min() >= 0
    means = {}
    for label in np.unique(head.labels[head.mask]):
        inside = (head.labels == label) & head.mask
        means[label] = (head.data[inside].mean(), new.data[inside].mean())
    old, now = np.array(list(means.values())).T
    assert np.abs(old - now).max() > 0.05
    # the structure inside a tissue is kept
    white = head.labels == 3
    assert np.corrcoef(head.data[white], new.data[white])[0, 1] > 0.5
    same = recoloured(head, np.random.default_rng(1))
    np.testing.assert_array_equal(new.data, same.data)


def test_without_labels_nothing_is_recoloured(head: TruthVolume) -> None:
    plain = replace(head, labels=None, ventricles=None)
    assert recoloured(plain, np.random.default_rng(0)) is plain
