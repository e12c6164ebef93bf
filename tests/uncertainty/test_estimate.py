"""Uncertainty map of a small fit: finite, in the volume's units, larger where slices disagree or are missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from g3r.acquisition.planes import Planes
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import render
from g3r.geometry import VolumeGrid
from g3r.uncertainty import UncertaintyInputs, estimate_uncertainty
from g3r.uncertainty.estimate import MEANING, UNCHECKED_NOTE, UNRELIABLE_NOTE, Uncertainty
from g3r.uncertainty.predictors import gather_predictors, mean_residual
from tests.gaussians.scenes import cloud_of, slices_of

SHAPE = (24, 22, 20)


@pytest.fixture
def grid() -> VolumeGrid:
    return VolumeGrid.isotropic([-11.5, -10.5, -9.5], [11.5, 10.5, 9.5], 1.0)


@pytest.fixture
def mask(grid: VolumeGrid) -> np.ndarray:
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    return np.linalg.norm(grid.world(index), axis=-1) < 8.5


def fit_of(noise: float) -> SliceFit:
    """A fit to axial slices of a few Gaussians, with noise in the upper half of the head."""
    rng = np.random.default_rng(0)
    identity = np.tile([1.0, 0, 0, 0], (200, 1))
    cloud = cloud_of(rng.uniform(-7, 7, (200, 3)), np.full((200, 3), 0.6), identity, np.full(200, 0.3))
    z = np.arange(-9.0, 9.1, 2.0)
    n = len(z)
    planes = Planes(
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        center_mm=np.c_[np.zeros((n, 2)), z],
        spacing_mm=np.ones((n, 2)),
        shape=np.full((n, 2), 20),
        psf_var_mm2=np.tile([0.26, 0.26, 0.72], (n, 1)),
    )
    value = render(cloud, planes).numpy()
    upper = z[planes.plane_id()] > 0
    value = value + np.where(upper, noise * rng.standard_normal(len(value)), 0).astype(np.float32)
    slices = slices_of(planes, value.astype(np.float32), np.ones(len(value), bool), 1, 2.0)
    return SliceFit(cloud=cloud, slices=slices, gain=np.ones(n), weight=np.ones(n), history=[], bias_field=[])


def uncertainty_of(fit: SliceFit, grid: VolumeGrid, mask: np.ndarray, **options: Any) -> Uncertainty:
    rng = np.random.default_rng(1)
    volume = (0.5 + 0.1 * rng.standard_normal(grid.shape)).astype(np.float32) * mask
    given: dict = {
        "prior": volume + np.float32(0.01),
        "density": np.full(grid.shape, 1.0, np.float32),
        "prior_grid": grid,
        "prior_share": np.full(grid.shape, 0.2, np.float32),
    }
    own: dict[str, Any] = {
        name: options.pop(name) for name in ("with_prior", "intensity", "reliable") if name in options
    }
    inputs = UncertaintyInputs(volume=volume, mask=mask, grid=grid, fit=fit, **{**given, **options})
    return estimate_uncertainty(inputs, **own)


def test_residual_is_where_the_noise_is(grid: VolumeGrid) -> None:
    fit = fit_of(0.1)
    found = mean_residual(fit, grid)
    assert found.shape == grid.shape
    # the mean absolute value of a normal deviate is 0.8 standard deviations
    assert np.median(found[6:18, 6:18, 14:17]) == pytest.approx(0.08, rel=0.15)
    assert np.median(found[6:18, 6:18, 3:6]) < 0.02


def test_slice_weights_decide_which_residuals_count(grid: VolumeGrid) -> None:
    fit = fit_of(0.1)
    down_weighted = np.where(fit.slices.planes.center_mm[:, 2] > 0, 1e-6, 1.0)
    found = mean_residual(replace(fit, weight=down_weighted), grid)
    assert found.max() < 0.02


def test_map_is_finite_and_ends_with_the_mask(grid: VolumeGrid, mask: np.ndarray) -> None:
    found = uncertainty_of(fit_of(0.02), grid, mask)
    assert np.isfinite(found.expected_error).all()
    assert (found.expected_error[mask] > 0).all()
    assert (found.expected_error[~mask] == 0).all()
    assert found.record["meaning"] == MEANING


def test_map_is_in_units_of_the_volume(grid: VolumeGrid, mask: np.ndarray) -> None:
    fit = fit_of(0.02)
    once = uncertainty_of(fit, grid, mask)
    thousand = uncertainty_of(fit, grid, mask, intensity=1000.0)
    np.testing.assert_allclose(thousand.expected_error, 1000 * once.expected_error, rtol=1e-5)
    assert thousand.record["median_in_mask"] == pytest.approx(1000 * once.record["median_in_mask"], rel=1e-5)


def test_noise_and_missing_slices_raise_it(grid: VolumeGrid, mask: np.ndarray) -> None:
    calm = uncertainty_of(fit_of(0.02), grid, mask).expected_error
    noisy = uncertainty_of(fit_of(0.2), grid, mask).expected_error
    upper = mask.copy()
    upper[:, :, :12] = False
    assert (noisy[upper] > calm[upper]).all()
    density = np.full(grid.shape, 1.0, np.float32)
    density[:12] = 0.02
    sparse = uncertainty_of(fit_of(0.02), grid, mask, density=density).expected_error
    left, right = mask.copy(), mask.copy()
    left[12:], right[:12] = False, False
    assert (sparse[left] > calm[left]).all()
    np.testing.assert_array_equal(sparse[right], calm[right])


@pytest.mark.parametrize(("reliable", "note"), [(False, UNRELIABLE_NOTE), (None, UNCHECKED_NOTE), (True, None)])
def test_doubted_registration_is_said(
    grid: VolumeGrid, mask: np.ndarray, reliable: bool | None, note: str | None
) -> None:
    record = uncertainty_of(fit_of(0.02), grid, mask, reliable=reliable).record
    assert record["registration_reliable"] is reliable
    assert record.get("note") == note


def test_without_a_prior_there_is_a_map_too(grid: VolumeGrid, mask: np.ndarray) -> None:
    found = uncertainty_of(fit_of(0.02), grid, mask, with_prior=False)
    assert np.isfinite(found.expected_error).all()
    assert found.record["calibration"] == "without prior"


def test_record_says_how_much_rests_on_the_prior(grid: VolumeGrid, mask: np.ndarray) -> None:
    share = np.where(np.arange(SHAPE[0])[:, None, None] < SHAPE[0] // 2, 0.8, 0.2) * np.ones(grid.shape)
    record = uncertainty_of(fit_of(0.02), grid, mask, prior_share=share.astype(np.float32)).record
    assert record["prior_share"]["mask_mostly_prior"] == pytest.approx(0.5)
    assert record["prior_share"]["mean_in_mask"] == pytest.approx(0.5)
    without = uncertainty_of(fit_of(0.02), grid, mask, with_prior=False, prior_share=None)
    assert "prior_share" not in without.record


def test_evidence_in_a_corner_of_the_grid(grid: VolumeGrid) -> None:
    corner = np.zeros(grid.shape, bool)
    corner[:3, :3, :3] = True
    flat = np.full(grid.shape, 0.5, np.float32)
    found = gather_predictors(flat, corner, grid, residual=flat, density=flat, prior=flat, prior_share=None)
    assert {len(values) for values in found.values()} == {27}
    assert found["edge"].max() < 1e-6  # the rim of the mask does not count as an edge of the image
    assert found["depth_mm"].min() == 1.0
