"""Intensity matching recovers gains and fields as far as crossing slices determine them; common parts stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from data_synth.phantom import fetal_brain_phantom
from g3r.acquisition.bias_basis import N_TERMS
from g3r.acquisition.planes import Slices
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.intensity_matching import match_intensities
from g3r.fitting.neighbour_gains import neighbour_gains
from g3r.geometry import VolumeGrid
from tests.registration.moving_heads import as_slices, simulated


@pytest.fixture(scope="module")
def plain() -> Slices:
    """Three stacks of a phantom in true poses, with gain 1 in every slice."""
    slices, _ = as_slices(simulated(fetal_brain_phantom(24, 1.2)))
    return slices


def shown(slices: Slices, log_gain: NDArray[np.float64], coefficients: NDArray[np.float64]) -> Slices:
    """The slices times gains [K] and fields [N, 5]."""
    factor = log_gain[slices.planes.plane_id()] + StackBiasField(slices).log_field(coefficients)
    return replace(slices, value=(slices.value * np.exp(factor)).astype(np.float32))


def matched(slices: Slices, weight: NDArray[np.float64] | None = None) -> tuple[NDArray[np.float64], Slices]:
    """Log-gains [K] found from initial gains of 1, and the slices without fields."""
    found = match_intensities(slices, np.ones(len(slices)), np.ones(len(slices)) if weight is None else weight)
    return np.log(found.gain), found.slices


def differences(slices: Slices, gain: NDArray[np.float64], reference: Slices) -> NDArray[np.float64]:
    """Logarithm [P'] of the ratio of matched intensities to those of other slices."""
    index = slices.pixel_index[reference.masked_value > 0.2 * reference.masked_value.max()]
    plane = slices.planes.plane_id()[index]
    return np.asarray(np.log(slices.value[index] / reference.value[index]) - gain[plane])


def test_gains_of_single_slices_are_found(plain: Slices, rng: np.random.Generator) -> None:
    log_gain = rng.normal(0, 0.15, len(plain))
    start, _ = matched(plain)
    found, _ = matched(shown(plain, log_gain, np.zeros((3, N_TERMS))))
    inside = np.bincount(plain.pixel_plane, minlength=len(plain)) > 200
    left = (found - start - (log_gain - log_gain.mean()))[inside]
    assert left.std() < 0.2 * log_gain.std()


def test_fields_in_plane_that_no_volume_shares_are_found(plain: Slices) -> None:
    """The fields are x y of the first two stacks, in their own planes."""
    coefficients = np.zeros((3, N_TERMS))
    coefficients[0, 3], coefficients[1, 3] = 0.4, -0.3
    start_gain, start = matched(plain)
    gain, found = matched(shown(plain, np.zeros(len(plain)), coefficients))
    before = differences(shown(plain, np.zeros(len(plain)), coefficients), np.zeros(len(plain)), plain)
    left = differences(found, gain - start_gain, start)
    assert left.std() < 0.3 * before.std()


def test_what_a_volume_shares_is_left_in_the_slices(plain: Slices) -> None:
    """A head that is brighter on one side stays so, since this cannot be distinguished from a coil."""
    world_mm = plain.planes.pixel_world_mm()
    shading = 0.2 * (world_mm[:, 0] - world_mm[plain.mask, 0].mean()) / 40.0
    shaded = replace(plain, value=(plain.value * np.exp(shading)).astype(np.float32))
    start_gain, start = matched(plain)
    gain, found = matched(shaded)
    index = plain.pixel_index[plain.masked_value > 0.2 * plain.masked_value.max()]
    plane = plain.planes.plane_id()[index]
    kept = np.log(found.value[index] / start.value[index]) - (gain - start_gain)[plane]
    slope = np.polyfit(shading[index], kept, 1)[0]
    assert slope == pytest.approx(1, abs=0.1)


def test_trends_that_registration_made_up_are_gone(plain: Slices) -> None:
    """The gains of each stack fall towards both ends, as if the head were darker there."""
    header = plain.header_pose
    along = np.zeros(len(plain))
    for stack in np.unique(plain.stack_id):
        own = plain.stack_id == stack
        place = header.translation_mm[own] @ header.rotation[np.flatnonzero(own)[0], :, 2] / 40.0
        along[own] = (place - place.mean()) ** 2
    start = match_intensities(plain, np.ones(len(plain)), np.ones(len(plain))).gain
    found = match_intensities(plain, np.exp(-0.5 * along), np.ones(len(plain))).gain
    assert np.abs(np.log(found / start)).max() < 0.1 * np.ptp(0.5 * along)


def test_slices_without_weight_keep_their_gains_and_disturb_no_others(plain: Slices) -> None:
    weight, dark = np.ones(len(plain)), np.zeros(len(plain))
    weight[20], dark[20] = 0.0, -2.0
    expected, _ = matched(plain, weight)
    found, _ = matched(shown(plain, dark, np.zeros((3, N_TERMS))), weight)
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_two_stacks_and_slices_without_weight_stay_as_they_are(plain: Slices) -> None:
    gain = np.linspace(0.9, 1.1, len(plain))
    two = plain.take(plain.stack_id != plain.stack_id[-1])
    for slices, weight in ((two, np.ones(len(two))), (plain, np.zeros(len(plain)))):
        found = match_intensities(slices, gain[: len(slices)], weight)
        assert found.slices is slices
        np.testing.assert_array_equal(found.gain, gain[: len(slices)])
        assert found.coefficients == []


def test_one_stack_has_its_gains_from_neighbours(plain: Slices) -> None:
    alone = plain.take(plain.stack_id == plain.stack_id[0])
    found = match_intensities(alone, np.ones(len(alone)), np.ones(len(alone)))
    assert found.slices is alone
    np.testing.assert_array_equal(found.gain, neighbour_gains(alone))
    assert found.coefficients == []


def test_dark_and_extreme_slices_give_finite_gains(plain: Slices) -> None:
    value = plain.value.copy()
    value[plain.planes.plane_id() == 10] = 0.0
    value[plain.planes.plane_id() == 30] *= 1e4
    found = match_intensities(replace(plain, value=value), np.ones(len(plain)), np.ones(len(plain)))
    assert np.isfinite(found.gain).all()
    assert np.isfinite(found.slices.value).all()


def test_a_rim_of_skull_and_fluid_in_the_masks_hardly_disturbs_the_brain() -> None:
    """Thin shells of strong contrast, as in hand-drawn masks, around slices without gains or fields."""
    head = fetal_brain_phantom(24, 1.2)
    outside_mm = distance_transform_edt(~head.mask, sampling=1.2)
    bright = float(head.t2.max())
    shells = np.select([head.mask, outside_mm < 2.5], [head.t2, 1.5 * bright], 0.05 * bright).astype(np.float32)
    slices, _ = as_slices(simulated(replace(head, t2=shells, mask=outside_mm < 5.0)))
    index = slices.pixel_index
    place = VolumeGrid(head.mask.shape, head.affine).index(slices.planes.pixel_world_mm(index))
    brain = index[map_coordinates(head.mask.astype(np.float32), place.T, order=1) > 0.5]
    gain, found = matched(slices)
    factor = gain[slices.planes.plane_id()[brain]] + np.log(slices.value[brain] / found.value[brain])
    assert len(brain) < 0.8 * len(index)
    assert factor.std() < 0.03
