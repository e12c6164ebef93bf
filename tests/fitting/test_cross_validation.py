"""The pull to V_0 is chosen by generalised cross-validation, which is held to the exact trace and to other noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_correction import (
    CLEARLY,
    FINEST_ACQUIRED_MM,
    LESS_HELD,
    LOOSE,
    TIGHT,
    VoxelCorrectionRecord,
    VoxelCorrectionSettings,
    correct_on_voxels,
)
from g3r.fitting.voxel_problem import FitPixels, VoxelProblem, VoxelProblemSettings
from g3r.geometry import VolumeGrid
from tests.fitting.scene import BALL, GRID, make_slices, true_cloud, true_volume

NOISE = 0.02
SOFT = gaussian_filter(true_volume(), 0.8)
"""A volume that lacks detail."""


def noisy_fit(seed: int, n_stacks: int = 3) -> SliceFit:
    """A fit with true poses, of slices with noise."""
    slices = make_slices()
    noise = np.random.default_rng(seed).normal(0, NOISE, len(slices.value)).astype(np.float32)
    stack_id = np.minimum(slices.stack_id, n_stacks - 1)
    slices = replace(slices, value=slices.value + noise, stack_id=stack_id)
    ones = np.ones(len(slices))
    return SliceFit(cloud=true_cloud(), slices=slices, gain=ones, weight=ones, history=[], bias_field=[])


def pixels_of(fit: SliceFit) -> FitPixels:
    return FitPixels.of(fit, fit.slices, fit.slices.mask.astype(np.float32))


def probe(pixels: FitPixels, seed: int = 2) -> NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal(len(pixels.value)).astype(np.float32)


def test_the_trace_is_that_of_the_dense_map() -> None:
    grid = VolumeGrid.isotropic([-8] * 3, [8] * 3, 2.0)
    pixels = pixels_of(noisy_fit(1))
    uneven = np.random.default_rng(5).uniform(0.2, 1.0, len(pixels.value)).astype(np.float32)
    pixels = replace(pixels, weight=uneven)
    settings = VoxelProblemSettings(hold=0.4, total_variation=0.0, tip=0.02, n_rounds=4, n_iterations=40)
    problem = VoxelProblem(pixels, grid, settings)
    units = np.eye(int(np.prod(grid.shape)), dtype=np.float32).reshape(-1, *grid.shape)
    dense = np.stack([problem.operator.forward(one) for one in units], axis=1).astype(np.float64)
    data = dense.T @ (uneven[:, None] * dense)
    exact = np.trace(np.linalg.solve(data + float(problem.hold) * np.eye(len(data)), data))
    n_pixels = uneven.sum() ** 2 / (uneven**2).sum()
    volume = np.zeros(grid.shape, np.float32)
    expected = pixels.error(volume, grid) / (1 - exact / n_pixels)
    found = np.mean([problem.cross_validation(volume, probe(pixels, seed)) for seed in range(8)])
    assert found == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("start", [SOFT, true_volume()], ids=["detail is missing", "nothing is missing"])
def test_cross_validation_orders_as_the_error_with_other_noise_does(start: NDArray[np.float32]) -> None:
    pixels, others = pixels_of(noisy_fit(1)), pixels_of(noisy_fit(9))
    estimate, error = [], []
    for settings in (LESS_HELD, TIGHT):
        problem = VoxelProblem(pixels, GRID, settings)
        found = problem.solved(start)
        estimate.append(problem.cross_validation(found, probe(pixels)))
        error.append(others.error(found, GRID))
    assert (estimate[0] < estimate[1]) == (error[0] < error[1])
    assert estimate[0] / estimate[1] == pytest.approx(error[0] / error[1], rel=0.03)


def corrected(
    volume: NDArray[np.float32], fit: SliceFit, settings: VoxelCorrectionSettings = TIGHT
) -> VoxelCorrectionRecord:
    weight, reach = fit.slices.mask.astype(np.float32), BALL.astype(np.float32)
    return correct_on_voxels(volume, volume, fit, weight, GRID, reach, settings, np.random.default_rng(0)).record


def test_the_pull_is_loose_where_the_volume_lacks_detail_alone() -> None:
    lacking, complete = corrected(SOFT, noisy_fit(1)), corrected(true_volume(), noisy_fit(1))
    assert lacking.loose_error is not None
    assert complete.loose_error is not None
    assert lacking.loose_error < CLEARLY < 1 < complete.loose_error
    assert lacking.hold / complete.hold == pytest.approx(LOOSE.hold / TIGHT.hold, rel=0.3)


def test_images_with_something_beside_the_brain_are_not_asked() -> None:
    fit = noisy_fit(1)
    value = np.where(fit.slices.mask, fit.slices.value, 1).astype(np.float32)
    record = corrected(SOFT, replace(fit, slices=replace(fit.slices, value=value)))
    assert record.loose_error is None
    assert record.hold >= TIGHT.hold


@pytest.mark.parametrize(("n_stacks", "loosens"), [(1, True), (2, True), (3, False)])
def test_few_stacks_and_fixed_settings_are_not_asked(n_stacks: int, loosens: bool) -> None:
    record = corrected(SOFT, noisy_fit(1, n_stacks), replace(TIGHT, loosens=loosens))
    assert record.loose_error is None
    assert record.hold >= TIGHT.hold


def test_few_pixels_and_interpolated_ones_are_not_asked() -> None:
    fit = noisy_fit(1)
    few = np.where(np.arange(len(fit.slices.value)) % 8 == 0, fit.slices.mask, False)
    assert corrected(SOFT, replace(fit, slices=replace(fit.slices, mask=few))).loose_error is None
    planes = fit.slices.planes
    fine = replace(planes, spacing_mm=0.9 * FINEST_ACQUIRED_MM * np.ones_like(planes.spacing_mm))
    assert corrected(SOFT, replace(fit, slices=replace(fit.slices, planes=fine))).loose_error is None


def test_other_settings_hold_as_they_are_where_the_volume_is_good() -> None:
    assert corrected(true_volume(), noisy_fit(1), replace(TIGHT, hold=1.5)).hold == pytest.approx(1.5, rel=0.1)
