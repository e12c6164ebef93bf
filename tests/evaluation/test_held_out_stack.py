"""Prediction of held-out stacks by volumes, in any pose and unit, with better scores for sharp volumes."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

pytest.importorskip("skimage")

from g3r.acquisition.images import Volume, load_volume
from g3r.acquisition.stacks import Stack, load_stack
from g3r.errors import InputError
from g3r.evaluation.held_out_stack import StackPrediction, predict_stack
from g3r.evaluation.slice_scores import score_slice

PIXEL_FWHM = 2.3548 / 12**0.5
"""FWHM of a Gaussian with the variance of a box of one pixel."""


@pytest.fixture(scope="module")
def truth(subject: Path) -> Volume:
    return load_volume(subject / "truth.nii.gz")


@pytest.fixture(scope="module")
def stack(subject: Path) -> Stack:
    """A stack as simulated: each pixel averages over its own area."""
    loaded = load_stack(subject / "stack-0.nii.gz", subject / "mask-0.nii.gz", 4.0)
    return replace(loaded, in_plane_fwhm_pixels=(PIXEL_FWHM, PIXEL_FWHM))


@pytest.fixture(scope="module")
def by_truth(truth: Volume, stack: Stack) -> StackPrediction:
    return predict_stack(truth, stack)


def test_the_truth_predicts_a_stack_up_to_its_noise(by_truth: StackPrediction) -> None:
    figures = by_truth.figures()
    assert figures["psnr_db"] > 28
    assert figures["ncc"] > 0.93
    assert figures["median_ncc"] > 0.95
    assert figures["counted_share"] > 0.8
    assert figures["n_slices"] == len(by_truth.slices) >= 10
    assert figures["psnr_db"] == pytest.approx(
        -10 * np.log10(np.average([s.mse for s in by_truth.slices], weights=[s.n_pixels for s in by_truth.slices]))
    )


def test_a_blurred_volume_predicts_less(truth: Volume, stack: Stack, by_truth: StackPrediction) -> None:
    blurred = replace(truth, data=gaussian_filter(truth.data, 2.0 / truth.grid.spacing_mm) * (truth.data != 0))
    worse, best = predict_stack(blurred, stack).figures(), by_truth.figures()
    assert worse["psnr_db"] < best["psnr_db"] - 2
    assert worse["high_pass_ncc"] < best["high_pass_ncc"] - 0.1
    assert worse["ssim"] < best["ssim"] - 0.03


def test_neither_unit_nor_orientation_matters(truth: Volume, stack: Stack, by_truth: StackPrediction) -> None:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", (100, -35, 60), degrees=True).as_matrix()
    motion[:3, 3] = (40, -25, 300)
    turned = predict_stack(replace(truth, data=truth.data * 37, affine=motion @ truth.affine), stack).figures()
    for name, expected in by_truth.figures().items():
        assert turned[name] == pytest.approx(expected, rel=0.03, abs=0.02), name


def test_only_what_a_volume_shows_counts(truth: Volume, stack: Stack, by_truth: StackPrediction) -> None:
    support = truth.data != 0
    support[: support.shape[0] // 2] = False
    half = predict_stack(truth, stack, support=support)
    assert 0.3 < half.counted_share / by_truth.counted_share < 0.6
    assert half.figures()["psnr_db"] == pytest.approx(by_truth.figures()["psnr_db"], abs=2)
    assert predict_stack(truth, stack, eroded_pixels=3).counted_share > by_truth.counted_share


def test_a_cut_volume_predicts_what_it_shows_as_well(truth: Volume, stack: Stack, by_truth: StackPrediction) -> None:
    """Voxels beyond the cut are not evidence; treated as zeros they would pull slices inwards."""
    cut = truth.data.copy()
    cut[:, : int(np.quantile(np.argwhere(cut != 0)[:, 1], 0.1))] = 0
    part = predict_stack(replace(truth, data=cut), stack)
    assert part.counted_share < 0.95 * by_truth.counted_share
    assert part.figures()["psnr_db"] == pytest.approx(by_truth.figures()["psnr_db"], abs=0.4)


def test_a_volume_that_shows_nothing(truth: Volume, stack: Stack) -> None:
    with pytest.raises(InputError, match="shows nothing"):
        predict_stack(replace(truth, data=truth.data * 0), stack)
    corner = np.zeros_like(truth.data)
    corner[:3, :3, :3] = 1
    with pytest.raises(InputError, match="lies where"):
        predict_stack(replace(truth, data=corner), stack)


def test_scores_of_a_slice(rng: np.random.Generator) -> None:
    observed = gaussian_filter(rng.normal(size=(40, 50)), 1.5)
    observed = 100 + 20 * observed / observed.std()
    counted = np.zeros((40, 50), bool)
    counted[4:36, 5:44] = True
    score = functools.partial(
        score_slice, counted=counted, spacing_mm=np.array([1.0, 1.2]), data_range=200.0, slice_index=7
    )
    same = score(3 * observed - 50, observed)
    assert (same.slice_index, same.n_pixels) == (7, counted.sum())
    assert same.mse < 1e-20
    assert [same.ncc, same.high_pass_ncc, same.ssim] == pytest.approx([1, 1, 1])
    noise = rng.normal(size=observed.shape)
    noisy = score(observed, observed + 2 * noise)
    assert noisy.mse == pytest.approx(1e-4, rel=0.15)
    # smooth shading lowers the correlation, but not the correlation of detail
    shade = np.linspace(-40, 40, 50)
    shaded = score(observed, observed + shade)
    assert shaded.ncc < 0.75
    assert shaded.high_pass_ncc > 0.97
    # ignored pixels may have any value
    beyond = np.where(counted, observed, 1e6)
    assert score(beyond, observed).ncc == pytest.approx(1)
