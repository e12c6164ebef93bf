"""Surroundings of a head, and masks that reach into them or lack a part of the head."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from data_synth.atlas import TruthVolume
from data_synth.mask_errors import MISSED_MM, RIM_MM, with_mask_errors, with_skull_rim
from data_synth.simulator import StackSettings, simulate_stacks


def test_a_rim_lies_outside_the_head(head: TruthVolume) -> None:
    seen = with_skull_rim(head, np.random.default_rng(0))
    np.testing.assert_array_equal(seen.data[head.mask], head.data[head.mask])
    assert seen.data[~head.mask].max() > 0.1
    assert seen.data.min() >= 0


@pytest.mark.parametrize("grow", [True, False])
def test_masks_grow_into_the_rim_or_shrink(head: TruthVolume, grow: bool) -> None:
    rng = np.random.default_rng(2)
    stacks = simulate_stacks(head.data, head.mask, head.affine, [StackSettings(resolution_mm=1.0)], rng)
    changed = with_mask_errors(stacks, rng, grow)
    before, after = stacks[0].stack.mask, changed[0].stack.mask
    assert (after.sum() > before.sum()) == grow
    larger, smaller = (after, before) if grow else (before, after)
    assert larger[smaller].all()


@pytest.mark.parametrize("grow", [True, False])
@pytest.mark.parametrize("pixel_mm", [0.5, 1.5])
def test_the_rim_is_as_wide_as_drawn_whatever_the_pixels(head: TruthVolume, grow: bool, pixel_mm: float) -> None:
    settings = StackSettings(resolution_mm=pixel_mm, thickness_mm=6.0)
    stacks = simulate_stacks(head.data, head.mask, head.affine, [settings], np.random.default_rng(2))
    before = stacks[0].stack.mask
    k = int(before.sum((0, 1)).argmax())
    for seed in range(5):
        (changed,) = with_mask_errors(stacks, np.random.default_rng(seed), grow)
        differs = (changed.stack.mask != before)[:, :, k]
        # the rim grows in steps of the taxicab metric
        away = distance_transform_cdt(~before[:, :, k] if grow else before[:, :, k], metric="taxicab")
        width_mm = away[differs].max() * pixel_mm
        drawn_mm = np.random.default_rng(seed).uniform(0.2, 1.0) * (RIM_MM if grow else MISSED_MM)
        # rounded to the nearest pixel, at least one
        assert abs(width_mm - drawn_mm) <= max(pixel_mm / 2, pixel_mm - drawn_mm) + 1e-9
        assert differs[away == 1].all()
