"""Scores against known values and against a plain recomputation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from g3r.evaluation.metrics import PSNR_CAP_DB, fit_intensity, score


@pytest.fixture
def head(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A smooth positive ball-shaped volume of 700 at most, and its mask."""
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in (44, 50, 40)), indexing="ij")
    radius = np.sqrt(sum(a**2 for a in axes))
    texture = 400 + 150 * np.sin(7 * axes[0]) * np.cos(5 * axes[1] + 2) + 100 * np.sin(9 * axes[2])
    mask = radius < 0.8
    return np.where(mask, texture, 0.0).astype(np.float32), mask


def plain(volume: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """The scores by their definition, recomputed over the whole arrays without shortcuts."""
    truth = reference.astype(float) / np.percentile(reference[mask].astype(float), 99.9)
    design = np.stack([volume[mask].astype(float), np.ones(mask.sum())], axis=1)
    gain, offset = np.linalg.lstsq(design, truth[mask], rcond=None)[0]
    fitted = np.where(mask, volume * gain + offset, 0)
    truth = np.where(mask, truth, 0)
    mse = ((fitted - truth)[mask] ** 2).mean()
    ssim = structural_similarity(truth, fitted, data_range=1.0, full=True)[1][mask].mean()
    return {
        "psnr_db": 10 * np.log10(1 / mse),
        "ssim": ssim,
        "ncc": np.corrcoef(fitted[mask], truth[mask])[0, 1],
        "rmse": np.sqrt(mse),
    }


@pytest.mark.parametrize("noise", [1.0, 20.0, 120.0])
def test_agrees_with_a_plain_recomputation(
    head: tuple[np.ndarray, np.ndarray], rng: np.random.Generator, noise: float
) -> None:
    reference, mask = head
    volume = (0.02 * (reference + rng.normal(0, noise, reference.shape)) + 3).astype(np.float32)
    found = score(volume, reference, mask)
    for name, value in plain(volume, reference, mask).items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-5), name


def test_identical_volumes_reach_the_cap(head: tuple[np.ndarray, np.ndarray]) -> None:
    reference, mask = head
    found = score(reference, reference, mask)
    assert found.psnr_db == PSNR_CAP_DB
    assert found.ssim == pytest.approx(1, abs=1e-9)
    assert found.ncc == pytest.approx(1, abs=1e-12)
    assert found.gain == pytest.approx(1, abs=1e-9)
    assert found.n_voxels == mask.sum()


@pytest.mark.parametrize("noise_share", [0.01, 0.05])
def test_known_noise_gives_known_psnr(
    head: tuple[np.ndarray, np.ndarray], rng: np.random.Generator, noise_share: float
) -> None:
    reference, mask = head
    data_range = np.percentile(reference[mask], 99.9)
    volume = reference + rng.normal(0, noise_share * data_range, reference.shape)
    found = score(volume, reference, mask)
    # the fit shrinks the noisy volume towards the mean, so the error keeps the share NCC^2 of its variance
    expected = -20 * np.log10(noise_share * found.ncc)
    assert found.psnr_db == pytest.approx(expected, abs=0.06)  # 3 sigma of the noise's own variance, 2e4 voxels
    assert found.data_range == pytest.approx(data_range, rel=1e-6)


@pytest.mark.parametrize("gain", [1e-6, 1.0, -2.0, 1e6])
def test_scale_and_offset_do_not_count(
    head: tuple[np.ndarray, np.ndarray], rng: np.random.Generator, gain: float
) -> None:
    reference, mask = head
    volume = reference + rng.normal(0, 30, reference.shape)
    plain_scores, scaled = score(volume, reference, mask), score(gain * volume + 5 * gain, reference, mask)
    assert scaled.psnr_db == pytest.approx(plain_scores.psnr_db, abs=1e-6)
    assert scaled.ssim == pytest.approx(plain_scores.ssim, abs=1e-8)


def test_outside_of_the_mask_does_not_count(head: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    reference, mask = head
    volume = reference + rng.normal(0, 30, reference.shape)
    elsewhere = np.where(mask, volume, 1e5)
    assert score(elsewhere, reference, mask) == score(volume, reference, mask)
    elsewhere[~mask] = np.nan
    assert score(elsewhere, reference, mask) == score(volume, reference, mask)


def test_mask_at_the_border(head: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    reference, mask = head
    reference, mask = reference[12:, :, 8:30] + 100, mask[12:, :, 8:30]
    volume = reference + rng.normal(0, 30, reference.shape)
    assert score(volume, reference, mask).ssim == pytest.approx(plain(volume, reference, mask)["ssim"], rel=1e-9)


def test_constant_volume(head: tuple[np.ndarray, np.ndarray]) -> None:
    reference, mask = head
    found = score(np.full_like(reference, 7), reference, mask)
    assert (found.gain, found.ncc) == (0, 0)
    expected = -20 * np.log10(reference[mask].astype(float).std() / found.data_range)
    assert found.psnr_db == pytest.approx(expected, abs=1e-6)


def test_thin_volume_has_scores(rng: np.random.Generator) -> None:
    reference = rng.uniform(1, 2, (9, 9, 3))
    found = score(reference + 0.1 * rng.normal(size=reference.shape), reference, np.ones_like(reference, bool))
    assert np.isfinite([found.psnr_db, found.ssim, found.ncc]).all()


def test_fit_is_the_least_squares_one(head: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    reference, mask = head
    volume = 3 * reference + rng.normal(0, 50, reference.shape)
    expected = np.polyfit(volume[mask].astype(float), reference[mask].astype(float), 1)
    np.testing.assert_allclose(fit_intensity(volume, reference, mask), expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, r, m: (v[1:], r, m), "shapes differ"),
        (lambda v, r, m: (v, r, m & False), "mask is empty"),
        (lambda v, r, m: (np.full_like(v, np.nan), r, m), "not finite"),
        (lambda v, r, m: (v, -r, m), "percentile"),
    ],
)
def test_what_cannot_be_scored_is_refused(
    head: tuple[np.ndarray, np.ndarray], change: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]], message: str
) -> None:
    reference, mask = head
    with pytest.raises(ValueError, match=message):
        score(*change(reference, reference, mask))
