"""Gains of a single stack are recovered as far as they change from slice to slice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_synth.phantom import fetal_brain_phantom
from g3r.acquisition.planes import Slices
from g3r.fitting.neighbour_gains import MIN_PIXELS, neighbour_gains
from g3r.geometry import RigidPose
from tests.registration.moving_heads import as_slices, simulated


@pytest.fixture(scope="module")
def alone() -> Slices:
    """One stack of a phantom, with gain 1 in every slice."""
    slices, _ = as_slices(simulated(fetal_brain_phantom(24, 1.2), n_stacks=1))
    return slices


def shown(slices: Slices, log_gain: np.ndarray) -> Slices:
    return replace(slices, value=(slices.value * np.exp(log_gain)[slices.planes.plane_id()]).astype(np.float32))


def test_gains_that_change_from_slice_to_slice_are_found(alone: Slices, rng: np.random.Generator) -> None:
    log_gain = rng.normal(0, 0.08, len(alone))
    inside = np.bincount(alone.pixel_plane, minlength=len(alone)) > 200
    found = np.log(neighbour_gains(shown(alone, log_gain)) / neighbour_gains(alone))
    steps = np.diff(log_gain[inside])
    assert (np.diff(found[inside]) - steps).std() < 0.25 * steps.std()
    assert found.mean() == pytest.approx(0, abs=1e-9)


def test_order_of_slices_does_not_matter(alone: Slices, rng: np.random.Generator) -> None:
    slices = shown(alone, rng.normal(0, 0.08, len(alone)))
    order = rng.permutation(len(slices))
    np.testing.assert_allclose(neighbour_gains(slices.take(order)), neighbour_gains(slices)[order], rtol=1e-9)


def test_slow_changes_are_left_to_the_anatomy(alone: Slices) -> None:
    place = np.linspace(-1, 1, len(alone))
    found = np.log(neighbour_gains(shown(alone, 0.2 * place)) / neighbour_gains(alone))
    assert np.ptp(found) < 0.5 * 0.4


def test_a_missing_slice_does_not_cut_the_stack(alone: Slices, rng: np.random.Generator) -> None:
    log_gain = rng.normal(0, 0.08, len(alone))
    kept = np.delete(np.arange(len(alone)), len(alone) // 2)
    whole, gap = neighbour_gains(shown(alone, log_gain))[kept], neighbour_gains(shown(alone, log_gain).take(kept))
    np.testing.assert_allclose(np.log(gap / gap.mean()), np.log(whole / whole.mean()), atol=0.04)


def test_slices_that_lie_half_a_pixel_apart_are_compared_all_the_same(alone: Slices, rng: np.random.Generator) -> None:
    log_gain = rng.normal(0, 0.08, len(alone))
    header = alone.header_pose
    aside = 0.5 * alone.planes.spacing_mm[0, 0] * (np.arange(len(alone)) % 2)
    moved = header.translation_mm + aside[:, None] * header.rotation[:, :, 0]
    slices = replace(shown(alone, log_gain), header_pose=RigidPose(header.rotation, moved))
    found, expected = neighbour_gains(slices), neighbour_gains(shown(alone, log_gain))
    np.testing.assert_allclose(np.log(found), np.log(expected), atol=0.05)


def test_black_and_bright_slices_give_finite_gains(alone: Slices) -> None:
    value = alone.value.copy()
    plane = alone.planes.plane_id()
    value[plane == 5], value[plane == 9] = 0, value[plane == 9] * 1e4
    gain = neighbour_gains(replace(alone, value=value))
    assert np.isfinite(gain).all()
    assert (gain > 0).all()


def test_slices_without_pixels_in_common_keep_their_gains(alone: Slices) -> None:
    mask = np.zeros_like(alone.mask)
    first = alone.planes.offset[:-1] + alone.planes.shape.prod(1) // 2
    for start in first:
        mask[start : start + MIN_PIXELS // 2] = True
    np.testing.assert_array_equal(neighbour_gains(replace(alone, mask=mask)), 1)


def test_slices_of_two_stacks_are_refused() -> None:
    slices, _ = as_slices(simulated(fetal_brain_phantom(24, 1.2), n_stacks=2))
    with pytest.raises(ValueError, match="2 stacks"):
        neighbour_gains(slices)
