"""Size and centre of a head are estimated correctly although slices are missing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, generate_binary_structure

from data_synth.phantom import fetal_brain_phantom
from g3r.acquisition.area_profile import area_profiles, head_volume_mm3
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from tests.acquisition.ellipsoids import TRUE_MM3, ellipsoid_stack
from tests.registration.moving_heads import as_slices, simulated


@pytest.fixture(scope="module")
def whole() -> Slices:
    return as_slices(simulated(fetal_brain_phantom(28, 1.5)))[0]


def without(slices: Slices, stack: int, first: float, last: float) -> Slices:
    """The slices without those of one stack between two fractions of its length."""
    rows = np.flatnonzero(slices.stack_id == stack)
    lost = rows[round(first * len(rows)) : round(last * len(rows))]
    return slices.take(np.setdiff1d(np.arange(len(slices)), lost))


def one_stack(slices: Slices, stack: int = 0) -> Slices:
    return slices.take(slices.stack_id == stack)


def test_a_whole_head_counts_as_masked(whole: Slices) -> None:
    for stack, profile in enumerate(area_profiles(whole)):
        one = one_stack(whole, stack)
        area_mm2 = np.bincount(one.pixel_plane, minlength=len(one)) * one.planes.spacing_mm.prod(1)
        assert profile.volume_mm3 == pytest.approx(area_mm2.sum() * profile.spacing_mm, rel=1e-12)
        assert not profile.has_missing
        assert profile.missing_share == 0
        assert profile.longest_gap_mm == 0


@pytest.mark.parametrize("beside", [0.0, 0.15])
def test_a_mask_far_too_wide_for_a_brain_in_black_counts_by_what_is_not_black(beside: float) -> None:
    """The template of the head is scaled by this volume, and the search in it fails if it is a third too large."""
    stack = ellipsoid_stack()
    disc = generate_binary_structure(2, 1)[:, :, None]
    noise = np.abs(np.random.default_rng(0).normal(0, beside, stack.image.shape)).astype(np.float32)
    image = np.where(stack.mask, 1 + noise, noise)
    wide = replace(stack, image=image, mask=binary_dilation(stack.mask, disc, iterations=6))
    assert wide.mask.sum() > 1.3 * stack.mask.sum()
    (found,) = area_profiles(slices_from_stacks([wide]))
    assert found.volume_mm3 == pytest.approx(TRUE_MM3, rel=0.1)


def test_a_mask_as_people_draw_it_counts_whole() -> None:
    stack = ellipsoid_stack()
    disc = generate_binary_structure(2, 1)[:, :, None]
    wide = replace(stack, image=stack.mask.astype(np.float32), mask=binary_dilation(stack.mask, disc, iterations=2))
    (given,), (found,) = area_profiles(slices_from_stacks([stack])), area_profiles(slices_from_stacks([wide]))
    assert found.volume_mm3 / given.volume_mm3 == pytest.approx(wide.mask.sum() / stack.mask.sum(), rel=0.03)


@pytest.mark.parametrize("span", [(0.45, 0.55), (0.35, 0.65)])
def test_missing_slices_are_put_back(whole: Slices, span: tuple[float, float]) -> None:
    (given,), (found,) = area_profiles(one_stack(whole)), area_profiles(without(one_stack(whole), 0, *span))
    assert found.n_inside == (~np.isin(given.index, found.index[found.seen])).sum()
    assert found.longest_gap_mm == pytest.approx(found.n_inside * found.spacing_mm)
    assert not found.is_cut
    assert found.volume_mm3 == pytest.approx(given.volume_mm3, rel=0.07)
    assert np.linalg.norm(found.head_center_mm - given.head_center_mm) < 2


@pytest.mark.parametrize(("span", "cut"), [((0.0, 0.4), (True, False)), ((0.6, 1.0), (False, True))])
def test_a_cut_head_is_continued(whole: Slices, span: tuple[float, float], cut: tuple[bool, bool]) -> None:
    (given,), (found,) = area_profiles(one_stack(whole, 2)), area_profiles(without(one_stack(whole, 2), 2, *span))
    seen_mm3 = float(found.area_mm2[found.seen].sum() * found.spacing_mm)
    assert found.cut == cut
    assert found.volume_mm3 == pytest.approx(given.volume_mm3, rel=0.1)
    assert seen_mm3 < 0.7 * given.volume_mm3
    assert found.missing_share == pytest.approx(1 - seen_mm3 / given.volume_mm3, abs=0.07)
    assert np.linalg.norm(found.head_center_mm - given.head_center_mm) < 3


def test_a_whole_head_in_thick_slices_is_not_called_cut_for_its_first_slice(whole: Slices) -> None:
    """The outermost slice lies up to its own thickness inside the head, where it is large."""
    slices = slices_from_stacks([ellipsoid_stack(thickness_mm=6.0, low_mm=-43.0)])
    (found,) = area_profiles(slices)
    assert found.cut == (True, False)
    assert found.cut_share is None
    (half,) = area_profiles(without(one_stack(whole, 2), 2, 0.0, 0.4))
    assert half.cut_share == half.missing_share > 0.3


def test_whole_stacks_say_the_volume(whole: Slices) -> None:
    cut = without(whole, 0, 0.5, 1.0)
    assert head_volume_mm3(cut) == pytest.approx(head_volume_mm3(whole), rel=0.05)
    assert area_profiles(cut)[0].volume_mm3 == pytest.approx(head_volume_mm3(whole), rel=0.15)


def test_all_stacks_cut(whole: Slices) -> None:
    halves = whole
    for stack in range(3):
        halves = without(halves, stack, 0.0, 0.5)
    assert head_volume_mm3(halves) == pytest.approx(head_volume_mm3(whole), rel=0.25)


def test_few_slices_are_taken_as_they_are(whole: Slices) -> None:
    few = one_stack(whole).take(np.arange(8, 11))
    (found,) = area_profiles(few)
    assert not found.has_missing
    assert found.seen.all()


def test_a_fragment_does_not_count_as_a_whole_head(whole: Slices) -> None:
    """Three slices at one end of a stack, beside a stack that is whole, and beside two that are cut."""
    true_mm3, lost = head_volume_mm3(whole), np.flatnonzero(whole.stack_id == 0)[3:]
    with_fragment = whole.take(np.setdiff1d(np.arange(len(whole)), lost))
    beside_whole = with_fragment.take(with_fragment.stack_id < 2)
    assert head_volume_mm3(beside_whole) == pytest.approx(true_mm3, rel=0.05)
    beside_cut = without(without(with_fragment, 1, 0.0, 0.3), 2, 0.0, 0.3)
    assert head_volume_mm3(beside_cut) == pytest.approx(true_mm3, rel=0.25)
    fragment, *cut = area_profiles(beside_cut)
    assert not fragment.is_cut
    assert not fragment.is_whole
    for profile in cut:
        assert profile.is_cut
        assert profile.volume_mm3 == pytest.approx(true_mm3, rel=0.25)


def test_fragments_alone_are_all_there_is(whole: Slices) -> None:
    few = whole.take(np.concatenate([np.flatnonzero(whole.stack_id == stack)[8:11] for stack in range(3)]))
    volumes = [one.volume_mm3 for one in area_profiles(few)]
    assert head_volume_mm3(few) == np.median(volumes) > 0
