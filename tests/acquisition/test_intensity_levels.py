"""Intensity levels of stacks on different intensity scales."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.intensity_levels import LEVEL_RANGE, gain_in_files, level_notes, same_level
from g3r.acquisition.stacks import Stack


def stack(level: float, name: str) -> Stack:
    """A stack of uneven values around a level, with black around."""
    rng = np.random.default_rng(0)
    mask = np.zeros((12, 12, 6), bool)
    mask[2:-2, 2:-2] = True
    image = level * rng.uniform(0.5, 1.5, mask.shape) * mask
    return Stack(image=image.astype(np.float32), mask=mask, affine=np.eye(4), thickness_mm=1.0, name=name)


@pytest.mark.parametrize("factor", [0.1, 1 / 3, 3.0])
def test_a_stack_on_another_scale_comes_to_that_of_the_others(factor: float) -> None:
    stacks = [stack(100.0, "a"), stack(100.0 * factor, "b"), stack(100.0, "c")]
    found = same_level(stacks)
    assert found[0] is stacks[0]
    assert found[2] is stacks[2]
    np.testing.assert_allclose(found[1].image, stacks[0].image, rtol=1e-5)
    assert level_notes(found) == [f"b: intensities times {1 / factor:.3g}, to match the other stacks"]
    gain = gain_in_files(np.ones(3), np.array([0, 1, 2]), found)
    np.testing.assert_allclose(gain, [1, factor, 1], rtol=1e-5)
    assert same_level(found) == found  # a second call changes nothing


def test_levels_that_gains_make_up_for_are_left_alone() -> None:
    stacks = [stack(100.0, "a"), stack(0.95 * LEVEL_RANGE * 100, "b"), stack(95.0, "c")]
    assert all(one is before for one, before in zip(same_level(stacks), stacks, strict=True))
    assert level_notes(stacks) == []


def test_black_in_a_mask_does_not_change_its_level() -> None:
    tight = stack(100.0, "a")
    wide = replace(tight, mask=np.ones_like(tight.mask), name="b")
    assert same_level([tight, wide]) == (tight, wide)


def test_a_single_stack_has_nothing_to_match() -> None:
    only = stack(7.0, "a")
    assert same_level([only]) == (only,)


def test_two_stacks_are_compared_with_each_other() -> None:
    """Each is within the range of their common level, but not of the other's."""
    found = same_level([stack(100.0, "a"), stack(100.0 * 1.4, "b")])
    np.testing.assert_allclose(found[0].image, found[1].image, rtol=1e-5)
    alike = [stack(100.0, "a"), stack(100.0 * 0.95 * LEVEL_RANGE, "b")]
    assert same_level(alike) == tuple(alike)
