"""The shipped weights find a head in its surroundings and outline it."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.heads import PhantomSubject, load_head
from data_synth.mask_head import filled_head
from g3r.mask_network.inference import find_brain
from g3r.mask_network.mask_shape import as_people_draw
from g3r.mask_network.model import MaskModel

pytest.importorskip("torchio")

from data_synth.mask_data import new_scene
from data_synth.mask_samples import full_stack
from data_synth.mask_scans import draw_scan

SEED = 3
"""Seed of an ordinary scan that shows the whole head in a uterus; `studies/masks` has difficult ones."""

PIXEL_MM = 1.2


def test_the_shipped_network_outlines_a_simulated_head() -> None:
    rng = np.random.default_rng(SEED)
    head = filled_head(load_head(PhantomSubject("29w", 29.0, 3), 1.6))
    scan = draw_scan(new_scene(head, rng), rng, negative=False, view_cut_share=0.0, level_share={"mild": 1.0})
    image, true = full_stack(scan, PIXEL_MM, rng)
    spacing_mm = np.array([PIXEL_MM, PIXEL_MM, scan.spacing_mm])
    assert true.any((0, 1)).sum() > 5
    assert true.mean() < 0.1
    assert (image[~true] > 0.2 * np.median(image[true])).mean() > 0.2, "there is hardly anything around the head"

    found = find_brain(image, spacing_mm.tolist(), MaskModel.load(None))
    assert found.found, found.reason
    off_mm = np.argwhere(true).mean(0) * spacing_mm - found.centre_mm
    assert np.linalg.norm(off_mm) < 15
    drawn = as_people_draw(true, spacing_mm)
    assert 2 * (found.mask & drawn).sum() / (found.mask.sum() + drawn.sum()) > 0.8
