"""What surrounds a head, and masks that reach into it or miss a part."""

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from data_synth.mask_errors import in_surroundings, with_mask_errors
from data_synth.simulator import StackSettings, simulate_stacks
from g3r.geometry import VolumeGrid


def test_a_head_in_surroundings_shows_them_beyond_its_brain(head: TruthVolume) -> None:
    seen = in_surroundings(head, np.random.default_rng(0))
    inside = VolumeGrid(seen.mask.shape, seen.affine).index(
        VolumeGrid(head.mask.shape, head.affine).world(np.argwhere(head.mask))
    )
    index = tuple(np.rint(inside).astype(int).T)
    np.testing.assert_allclose(inside, np.stack(index, -1), atol=1e-3)
    np.testing.assert_array_equal(seen.data[index], head.data[head.mask])
    assert seen.mask[index].mean() > 0.999  # the skull is smoother than the mask
    beyond = ~seen.mask
    assert seen.data[beyond].max() > 0.1
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
