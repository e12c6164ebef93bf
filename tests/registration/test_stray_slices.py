"""Slices astray are found again; slices that fit, and slices without content, are not searched."""

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import DARK
from g3r.geometry import RigidPose
from g3r.registration import RegistrationSettings, stray_slices
from g3r.registration.similarity import CORRELATION_AREA_MM2
from g3r.registration.slice_rounds import refine_slices
from g3r.registration.stray_slices import find_strays
from tests.registration.moving_heads import off_mm, with_jerk

STACK = 1


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def astray(still_slices: tuple[Slices, RigidPose]) -> tuple[Slices, np.ndarray]:
    """Three stacks with a jerk during two slices that are consecutive in time (interleave 2)."""
    slices = still_slices[0]
    middle = int(np.median(slices.slice_index[slices.stack_id == STACK]))
    at = np.flatnonzero((slices.stack_id == STACK) & np.isin(slices.slice_index, [middle, middle + 2]))
    return with_jerk(slices, at), at


def test_slices_of_one_jerk_are_found_again(
    still_slices: tuple[Slices, RigidPose], astray: tuple[Slices, np.ndarray]
) -> None:
    slices, at = astray
    weight = np.ones(len(slices))
    weight[at] = 1e-3
    found, n_found = find_strays(slices, np.ones(len(slices)), weight, np.ones(len(slices)), rng())
    assert n_found == len(at)
    assert off_mm(slices, still_slices[0])[at].min() > 8
    assert off_mm(found, still_slices[0])[at].max() < 4.0  # the slice thickness
    others = np.delete(np.arange(len(slices)), at)
    assert np.array_equal(found.planes.pose.rotation[others], slices.planes.pose.rotation[others])
    assert np.array_equal(found.planes.pose.translation_mm[others], slices.planes.pose.translation_mm[others])


@pytest.mark.parametrize(("ncc", "expected"), [(0.78, 2), (0.82, 0)])
def test_slices_with_all_their_weight_are_searched_where_they_are_unlike_the_volume(
    still_slices: tuple[Slices, RigidPose], astray: tuple[Slices, np.ndarray], ncc: float, expected: int
) -> None:
    slices, at = astray
    ones, ncc_of_all = np.ones(len(slices)), np.full(len(slices), 0.9)
    ncc_of_all[at] = ncc
    found, n_found = find_strays(slices, ones, ones, ncc_of_all, rng())
    assert n_found == expected
    assert (off_mm(found, still_slices[0])[at].max() < 4.0) == (expected > 0)


def test_a_stack_that_is_unlike_the_volume_as_a_whole_is_not_searched(
    still_slices: tuple[Slices, RigidPose], astray: tuple[Slices, np.ndarray]
) -> None:
    """With most slices astray there is no volume in which they could be found."""
    slices, at = astray
    ones, own = np.ones(len(slices)), np.flatnonzero(slices.stack_id == STACK)
    for share, expected in ((0.4, True), (0.6, False)):
        ncc = np.full(len(slices), 0.9)
        ncc[np.union1d(at, own[: round(share * len(own))])] = 0.7
        assert (find_strays(slices, ones, ones, ncc, rng())[1] > 0) == expected


def test_rounds_end_with_the_search(still_slices: tuple[Slices, RigidPose], astray: tuple[Slices, np.ndarray]) -> None:
    slices, at = astray
    settings = RegistrationSettings(n_rounds=4, finest_voxel_mm=1.8, stray_searches=0)
    without = refine_slices(slices, settings)
    found = refine_slices(slices, replace(settings, stray_searches=2))
    assert off_mm(without.slices, still_slices[0])[at].min() > 5
    assert off_mm(found.slices, still_slices[0])[at].max() < 1.5
    assert len(found.history) > len(without.history)
    assert found.weight[at].min() > without.weight[at].max()


def test_strays_are_found_where_headers_place_the_stacks_far_apart(
    still_slices: tuple[Slices, RigidPose], astray: tuple[Slices, np.ndarray]
) -> None:
    """Turns are about the head of the stack by its own header, so it stays about where it was."""
    slices, at = astray
    header = slices.header_pose
    far = np.array([0.0, 250.0, 0.0]) * (slices.stack_id[:, None] != STACK)
    apart = replace(slices, header_pose=RigidPose(header.rotation, header.translation_mm + far))
    weight = np.ones(len(slices))
    weight[at] = 1e-3
    found, n_found = find_strays(apart, np.ones(len(slices)), weight, np.ones(len(slices)), rng())
    assert n_found == len(at)
    assert off_mm(found, still_slices[0])[at].max() < 4.0  # the slice thickness


def test_slices_that_fit_cost_no_search(still_slices: tuple[Slices, RigidPose]) -> None:
    slices, ones = still_slices[0], np.ones(len(still_slices[0]))
    assert find_strays(slices, ones, ones, ones, rng()) == (slices, 0)


def test_where_nothing_fits_nothing_is_searched(astray: tuple[Slices, np.ndarray]) -> None:
    slices, ones = astray[0], np.ones(len(astray[0]))
    assert find_strays(slices, ones, 1e-3 * ones, ones, rng()) == (slices, 0)


def test_dark_slices_are_not_searched(astray: tuple[Slices, np.ndarray]) -> None:
    slices, at = astray
    gain, weight = np.ones(len(slices)), np.ones(len(slices))
    gain[at], weight[at] = 0.9 * DARK, 1e-3
    assert find_strays(slices, gain, weight, np.ones(len(slices)), rng()) == (slices, 0)


def test_small_slices_are_not_searched(astray: tuple[Slices, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    slices, at = astray
    weight = np.ones(len(slices))
    weight[at] = 1e-3
    n_samples = slices.planes.shape.prod(1) * slices.planes.spacing_mm.prod(1) / CORRELATION_AREA_MM2
    monkeypatch.setattr(stray_slices, "MIN_SAMPLES", 1.01 * n_samples[at].max())
    assert find_strays(slices, np.ones(len(slices)), weight, np.ones(len(slices)), rng()) == (slices, 0)
