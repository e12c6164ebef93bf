"""Intensity levels of stacks on different intensity scales."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.intensity_levels import BRIGHT, LEVEL_RANGE, gain_in_files, level_notes, same_level
from g3r.acquisition.slicing import slices_from_stacks
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
    slices = slices_from_stacks(found)
    gain = gain_in_files(np.ones(len(slices)), slices, found)
    np.testing.assert_allclose(gain, np.array([1, factor, 1])[slices.stack_id], rtol=1e-5)
    again = same_level(found)
    assert all(one is before for one, before in zip(again, found, strict=True))  # a second call changes nothing


def test_levels_that_gains_make_up_for_are_left_alone() -> None:
    stacks = [stack(100.0, "a"), stack(0.95 * LEVEL_RANGE * 100, "b"), stack(95.0, "c")]
    assert all(one is before for one, before in zip(same_level(stacks), stacks, strict=True))
    assert level_notes(stacks) == []


def test_black_in_a_mask_does_not_change_its_level() -> None:
    tight = stack(100.0, "a")
    wide = replace(tight, mask=np.ones_like(tight.mask), name="b")
    found = same_level([tight, wide])
    assert found[0] is tight
    assert found[1] is wide


def test_a_single_stack_has_nothing_to_match() -> None:
    only = stack(7.0, "a")
    assert same_level([only])[0] is only


def test_two_stacks_are_compared_with_each_other() -> None:
    """Each is within the range of their common level, but not of the other's."""
    found = same_level([stack(100.0, "a"), stack(100.0 * 1.4, "b")])
    np.testing.assert_allclose(found[0].image, found[1].image, rtol=1e-5)
    alike = [stack(100.0, "a"), stack(100.0 * 0.95 * LEVEL_RANGE, "b")]
    assert all(one is before for one, before in zip(same_level(alike), alike, strict=True))


def test_a_slice_that_is_much_too_bright_comes_to_the_level_of_its_stack() -> None:
    usual = stack(100.0, "a")
    factor = np.array([1, 1, 1.1 * BRIGHT, 1, 0.9 * BRIGHT, 0.1])
    spoilt = replace(usual, image=usual.image * factor.astype(np.float32))
    (found, _) = same_level([spoilt, stack(100.0, "b")])
    typical = [float(np.median(found.image[:, :, k][found.mask[:, :, k]])) for k in range(6)]
    # the others stay: bright ones may show fluid, dark ones may have lost their signal
    assert typical[2] == pytest.approx(100, rel=0.2)
    assert typical[4] == pytest.approx(90 * BRIGHT, rel=0.2)
    assert typical[5] == pytest.approx(10, rel=0.2)
    assert level_notes([found]) == ["a: slices 2 darkened to the level of the others, more than 3 times"]
    slices = slices_from_stacks([found])
    in_files = gain_in_files(np.ones(6), slices, [found])
    np.testing.assert_allclose(in_files[2], 1.1 * BRIGHT, rtol=0.2)
    np.testing.assert_array_equal(np.delete(in_files, 2), 1)
