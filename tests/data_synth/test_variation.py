"""Other contrasts, pathologies, rims and masks of training heads."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from data_synth.contrast import recoloured
from data_synth.heads import PhantomSubject, load_volume_of
from data_synth.motion import LEVELS, slice_trajectory
from data_synth.pathology import enlarged_ventricles, with_lesion, with_lesions
from data_synth.protocol_sampling import draw_settings, rigid_stack, with_mask_errors, with_skull_rim
from data_synth.simulator import StackSettings, simulate_stacks
from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.slicing import slices_from_stacks
from g3r.errors import InputError
from g3r.geometry import VolumeGrid

SPACING_MM = 1.6


@pytest.fixture(scope="module")
def head() -> TruthVolume:
    return load_volume_of(PhantomSubject("30w", 30.0, 3), SPACING_MM)


def test_a_recoloured_head_keeps_its_tissues_apart(head: TruthVolume) -> None:
    assert head.labels is not None
    new = recoloured(head, np.random.default_rng(1))
    assert new.data.dtype == np.float32
    assert (new.data[~head.mask] == 0).all()
    assert new.data.min() >= 0
    means = {}
    for label in np.unique(head.labels[head.mask]):
        inside = (head.labels == label) & head.mask
        means[label] = (head.data[inside].mean(), new.data[inside].mean())
    old, now = np.array(list(means.values())).T
    assert np.abs(old - now).max() > 0.05
    # the structure inside a tissue is still there
    white = head.labels == 3
    assert np.corrcoef(head.data[white], new.data[white])[0, 1] > 0.5
    same = recoloured(head, np.random.default_rng(1))
    np.testing.assert_array_equal(new.data, same.data)


def test_without_labels_nothing_is_recoloured(head: TruthVolume) -> None:
    plain = replace(head, labels=None, ventricles=None)
    assert recoloured(plain, np.random.default_rng(0)) is plain
    assert enlarged_ventricles(plain, 3.0) is plain


def test_ventricles_grow_and_the_head_does_not(head: TruthVolume) -> None:
    assert head.ventricles is not None
    before = head.ventricles.sum()
    sizes = []
    for translation_mm in (0.0, 2.0, 4.0):
        grown = enlarged_ventricles(head, translation_mm)
        sizes.append(grown.ventricles.sum() / before)
        np.testing.assert_array_equal(grown.mask, head.mask)
        assert np.isfinite(grown.data).all()
    assert sizes[0] == pytest.approx(1, abs=0.02)
    assert sizes[1] > 1.15
    assert sizes[2] > sizes[1] + 0.15
    with pytest.raises(ValueError, match="expected 0 to"):
        enlarged_ventricles(head, 5.0)


def test_a_lesion_has_its_size_and_brightness(head: TruthVolume) -> None:
    center = np.argwhere(head.mask).mean(0).round().astype(int)
    lesion = with_lesion(head, center, np.array([5.0, 5.0, 5.0]), 1.1)
    assert lesion.data[tuple(center)] == pytest.approx(1.1, abs=1e-3)
    index = np.moveaxis(np.indices(head.data.shape), 0, -1)
    away = np.linalg.norm((index - center) * SPACING_MM, axis=-1)
    np.testing.assert_array_equal(lesion.data[away > 9], head.data[away > 9])
    inside = away < 4
    assert np.abs(lesion.data[inside] - 1.1).max() < 0.02
    several = with_lesions(head, np.random.default_rng(5))
    assert (several.data[~head.mask] == 0).all()
    assert (several.data != head.data).any()


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


def test_overlapping_slices_measure_more_than_once(head: TruthVolume) -> None:
    density = {}
    for gap_mm in (-1.5, 0.0, 1.5):
        settings = StackSettings(resolution_mm=1.5, thickness_mm=3.0, gap_mm=gap_mm)
        stacks = simulate_stacks(head.data, head.mask, head.affine, [settings], np.random.default_rng(0))
        slices = slices_from_stacks([stacks[0].stack])
        grid = VolumeGrid(head.data.shape, head.affine)
        density[gap_mm] = float(coarse_and_density(slices, grid)[1][head.mask].mean())
    assert density[0.0] == pytest.approx(1, abs=0.08)
    assert density[-1.5] == pytest.approx(2, abs=0.16)
    assert density[1.5] == pytest.approx(2 / 3, abs=0.08)
    with pytest.raises(InputError, match="gap"):
        StackSettings(thickness_mm=2.0, gap_mm=-2.0)


def test_spikes_are_stripes_over_a_few_slices(head: TruthVolume) -> None:
    def image(share: float) -> np.ndarray:
        settings = StackSettings(resolution_mm=1.5, thickness_mm=3.0, snr=np.inf, spike_share=share)
        return simulate_stacks(head.data, head.mask, head.affine, [settings], np.random.default_rng(4))[0].stack.image

    clean, spiked = image(1e-12), image(0.3)
    differs = np.abs(spiked - clean).max((0, 1)) > 0
    assert 0 < differs.sum() < clean.shape[2]


def test_draws_cover_what_protocols_do() -> None:
    drawn = [draw_settings("none", np.random.default_rng(seed)) for seed in range(400)]
    counts = np.bincount([len(one) for one in drawn], minlength=7)
    assert (counts[1:] > 0).all()
    assert counts[1] > 80
    gaps = np.array([one[0].gap_mm for one in drawn])
    thickness = np.array([one[0].thickness_mm for one in drawn])
    resolution = np.array([one[0].resolution_mm for one in drawn])
    assert (gaps > 0).any()
    assert (gaps < 0).any()
    assert (gaps == 0).any()
    assert thickness.min() >= 2
    assert thickness.max() > 4.5
    assert 0.5 <= resolution.min() < 0.6
    assert 1.2 < resolution.max() <= 1.3
    assert len(draw_settings("none", np.random.default_rng(0), n_stacks=5)) == 5


def test_in_line_is_one_motion_close_to_all() -> None:
    center = np.array([3.0, -40.0, 12.0])
    true = slice_trajectory(30, LEVELS["mild"], center, 2, np.random.default_rng(1))
    one = rigid_stack(true, center)
    np.testing.assert_allclose(one.rotation, np.repeat(one.rotation[:1], 30, 0))
    away = np.linalg.norm(
        one.apply(np.tile(center, (30, 1, 1)))[:, 0] - true.apply(np.tile(center, (30, 1, 1)))[:, 0], axis=1
    )
    still = np.linalg.norm(true.apply(np.tile(center, (30, 1, 1)))[:, 0] - center, axis=1)
    assert away.mean() < 0.6 * still.mean()
    exact = rigid_stack(true.take(np.full(30, 4)), center)
    np.testing.assert_allclose(exact.rotation, true.take(np.full(30, 4)).rotation, atol=1e-9)
    np.testing.assert_allclose(exact.translation_mm, true.take(np.full(30, 4)).translation_mm, atol=1e-6)
