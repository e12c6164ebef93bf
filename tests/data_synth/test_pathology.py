"""Enlarged ventricles, and lesions."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from data_synth.pathology import enlarged_ventricles, with_lesion, with_lesions
from tests.data_synth.conftest import HEAD_SPACING_MM


def test_ventricles_grow_and_the_head_does_not(head: TruthVolume) -> None:
    assert head.ventricles is not None
    before = head.ventricles.sum()
    sizes = []
    for translation_mm in (0.0, 2.0, 4.0):
        grown = enlarged_ventricles(head, translation_mm)
        assert grown.ventricles is not None
        sizes.append(grown.ventricles.sum() / before)
        np.testing.assert_array_equal(grown.mask, head.mask)
        assert np.isfinite(grown.data).all()
    assert sizes[0] == pytest.approx(1, abs=0.02)
    assert sizes[1] > 1.15
    assert sizes[2] > sizes[1] + 0.15
    with pytest.raises(ValueError, match="expected 0 to"):
        enlarged_ventricles(head, 5.0)


def test_without_ventricles_nothing_grows(head: TruthVolume) -> None:
    plain = replace(head, labels=None, ventricles=None)
    assert enlarged_ventricles(plain, 3.0) is plain


def test_a_lesion_has_its_size_and_brightness(head: TruthVolume) -> None:
    center = np.argwhere(head.mask).mean(0).round().astype(int)
    lesion = with_lesion(head, center, np.array([5.0, 5.0, 5.0]), 1.1)
    assert lesion.data[tuple(center)] == pytest.approx(1.1, abs=1e-3)
    index = np.moveaxis(np.indices(head.data.shape), 0, -1)
    away = np.linalg.norm((index - center) * HEAD_SPACING_MM, axis=-1)
    np.testing.assert_array_equal(lesion.data[away > 9], head.data[away > 9])
    inside = away < 4
    assert np.abs(lesion.data[inside] - 1.1).max() < 0.02
    several = with_lesions(head, np.random.default_rng(5))
    assert (several.data[~head.mask] == 0).all()
    assert (several.data != head.data).any()
