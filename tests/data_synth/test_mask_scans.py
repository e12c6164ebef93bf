"""Scans of scenes: position of the mask, limits of the field of view, samples and artefacts."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from data_synth.mask_head import filled_head

pytest.importorskip("torchio")

from data_synth import mask_samples, mask_scans
from data_synth.mask_data import new_scene
from data_synth.mask_samples import draw_sample, full_stack, with_artefacts
from data_synth.mask_scans import Scan, Scene, draw_scan

SHAPES = {"wide_mm": 4.0, "wide_shape": (64, 64, 6), "pixel_mm": 2.4, "crop_shape": (64, 64, 6)}


@pytest.fixture(scope="module")
def scene(centred_head: TruthVolume) -> Scene:
    return new_scene(filled_head(centred_head), np.random.default_rng(5))


def whole(scan: Scan, pixel_mm: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    shape = (int(scan.fov_mm[0] / pixel_mm), int(scan.fov_mm[1] / pixel_mm))
    return scan.images((-scan.fov_mm[0] / 2, -scan.fov_mm[1] / 2), pixel_mm, shape)


@pytest.mark.parametrize("seed", range(4))
def test_the_mask_holds_the_head(scene: Scene, seed: int) -> None:
    """Mask volumes of whole scans equal the head's volume unless the scan cuts it."""
    scan = draw_scan(scene, np.random.default_rng(seed), negative=False)
    image, inside = whole(scan)
    assert image.shape == inside.shape
    assert inside.min() >= 0
    assert inside.max() <= 1.001
    head = scene.head
    true_ml = head.inside.sum() * abs(np.linalg.det(head.affine[:3, :3])) / 1000
    seen_ml = inside.sum() * 9 * scan.spacing_mm / 1000
    assert 0.1 * true_ml < seen_ml < 1.2 * true_ml


@pytest.mark.parametrize("seed", range(4))
def test_the_mask_has_the_head_s_volume_where_nothing_cuts_it(
    scene: Scene, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mask_scans, "CUT_SHARE", 0.0)
    still = {"none": 1.0}
    rng = np.random.default_rng(seed)
    scan = draw_scan(scene, rng, negative=False, view_cut_share=0.0, level_share=still)
    _, inside = whole(scan)
    true_ml = scene.head.inside.sum() * abs(np.linalg.det(scene.head.affine[:3, :3])) / 1000
    assert inside.sum() * 9 * scan.spacing_mm / 1000 == pytest.approx(true_ml, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_negatives_have_empty_masks_and_are_no_empty_images(scene: Scene, seed: int) -> None:
    scan = draw_scan(scene, np.random.default_rng(seed), negative=True)
    image, inside = whole(scan)
    assert (inside > 0.5).sum() * 9 * scan.spacing_mm / 1000 < 5  # a moving head may enter the field of view
    assert (image > 0).mean() > 0.01


def test_beyond_the_field_of_view_is_black(scene: Scene) -> None:
    scan = draw_scan(scene, np.random.default_rng(1), negative=False)
    half = scan.fov_mm / 2
    image, inside = scan.images((half[0] + 1, -half[1]), 3.0, (10, 20))
    assert not image.any()
    assert not inside.any()


def test_a_part_of_a_scan_is_the_same_part_of_the_whole(scene: Scene) -> None:
    scan = draw_scan(scene, np.random.default_rng(2), negative=False)
    all_of_it, _ = scan.images((-60.0, -60.0), 2.0, (60, 60))
    part, _ = scan.images((-40.0, -60.0), 2.0, (30, 60), slice(3, 7))
    np.testing.assert_allclose(part, all_of_it[10:40, :, 3:7], atol=2e-4)


def test_samples_have_the_stated_shapes_and_crops_lie_near_the_head(scene: Scene) -> None:
    rng = np.random.default_rng(4)
    sample = draw_sample(draw_scan(scene, rng, negative=False), rng, **SHAPES)  # type: ignore[arg-type]
    assert sample.wide_image.shape == sample.wide_mask.shape == (64, 64, 6)
    assert sample.image.shape == sample.mask.shape == (64, 64, 6)
    for image in (sample.image, sample.wide_image):
        assert np.isfinite(image).all()
        assert image.dtype == np.float32
    # the crop is centred near the head
    at = np.argwhere(sample.mask > 0.5)[:, :2].mean(0)
    assert np.abs(at - 31.5).max() * 2.4 < 40


def test_a_full_stack_and_its_mask(scene: Scene) -> None:
    rng = np.random.default_rng(6)
    scan = draw_scan(scene, rng, negative=False)
    image, true = full_stack(scan, 2.0, rng)
    assert image.shape == true.shape == (*(int(mm / 2) for mm in scan.fov_mm), len(scan.depth_mm))
    assert 0 < true.mean() < 0.5


def test_artefacts_keep_shape_and_are_reproducible(rng: np.random.Generator) -> None:
    image = rng.random((24, 20, 5)).astype(np.float32)
    first, second = (with_artefacts(image, np.random.default_rng(8), 1.0) for _ in range(2))
    assert first.shape == image.shape
    assert (first >= 0).all()
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("seed", range(6))
def test_artefacts_stay_within_their_slice(
    seed: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Artefacts are applied slice by slice, so no slice affects another, motion artefacts included."""
    monkeypatch.setattr(mask_samples, "MOTION_SHARE", 1.0)
    image = rng.random((24, 20, 5)).astype(np.float32)
    other = image.copy()
    other[:, :, 2] = rng.random((24, 20))
    made = [with_artefacts(one, np.random.default_rng(seed), 1.0) for one in (image, other)]
    change = np.abs(made[0] - made[1]).max((0, 1))
    assert change[2] > 0.1
    assert np.delete(change, 2).max() < 1e-5
