"""What surrounds a head, and masks that reach into it or miss a part."""

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from data_synth.mask_errors import with_mask_errors, with_skull_rim
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
