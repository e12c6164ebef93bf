"""Heads of scenes: filled masks and the layers around them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, label

from data_synth.atlas import TruthVolume
from data_synth.mask_head import CLOSING_MM, FLUID_INTENSITY, SceneHead, filled_head, scene_head
from data_synth.mask_labels import Tissue


@pytest.fixture(scope="module")
def filled(centred_head: TruthVolume) -> TruthVolume:
    """The phantom in its skull."""
    return filled_head(centred_head)


@pytest.fixture(scope="module")
def layered(filled: TruthVolume) -> SceneHead:
    return scene_head(filled, np.random.default_rng(3))


def test_clefts_are_filled_with_fluid_and_the_brain_stays(centred_head: TruthVolume) -> None:
    cut = centred_head.mask.copy()
    middle = cut.shape[0] // 2
    cut[middle - 1 : middle + 2, :, cut.shape[2] // 2 :] = False  # a cleft of 6 mm between the hemispheres
    assert 2 * CLOSING_MM > 6
    found = filled_head(replace(centred_head, data=np.where(cut, centred_head.data, 0), mask=cut))
    margin = (found.mask.shape[0] - cut.shape[0]) // 2
    inner = found.mask[margin:-margin, margin:-margin, margin:-margin]
    data = found.data[margin:-margin, margin:-margin, margin:-margin]
    cleft = centred_head.mask & ~cut
    assert inner[cleft].mean() > 0.9
    np.testing.assert_array_equal(data[cut], centred_head.data[cut])
    np.testing.assert_allclose(data[cleft & inner], FLUID_INTENSITY)
    assert (found.data[~found.mask] == 0).all()


def test_the_frame_stays(centred_head: TruthVolume, filled: TruthVolume) -> None:
    def centre(head: TruthVolume) -> np.ndarray:
        return head.affine[:3, :3] @ np.argwhere(head.mask).mean(0) + head.affine[:3, 3]

    np.testing.assert_allclose(centre(filled), centre(centred_head), atol=2.0)


def test_every_layer_is_there_and_skull_encloses_the_brain(layered: SceneHead) -> None:
    share = {tissue: (layered.labels == tissue).mean() for tissue in Tissue}
    for tissue in (Tissue.BRAIN, Tissue.SKULL, Tissue.SCALP, Tissue.EYE, Tissue.CORD, Tissue.OUTSIDE):
        assert share[tissue] > 1e-4, tissue
    assert share[Tissue.BRAIN] > share[Tissue.SKULL]
    inner = np.isin(layered.labels, (Tissue.BRAIN, Tissue.CSF))
    around = binary_dilation(inner) & ~inner
    assert (layered.labels[around] == Tissue.SKULL).mean() > 0.95  # except where it is thinner than half a voxel


def test_the_mask_is_brain_and_outer_fluid(layered: SceneHead) -> None:
    inner = np.isin(layered.labels, (Tissue.BRAIN, Tissue.CSF))
    np.testing.assert_array_equal(layered.inside > 0.5, inner)
    assert (layered.brain[layered.labels != Tissue.BRAIN] == 0).all()


def test_both_eyes_are_in_front(layered: SceneHead) -> None:
    parts, n = label(layered.labels == Tissue.EYE)
    assert n == 2
    at = [layered.affine[:3, :3] @ np.argwhere(parts == k).mean(0) + layered.affine[:3, 3] for k in (1, 2)]
    assert at[0][0] * at[1][0] < 0
    assert min(p[1] for p in at) > 0
