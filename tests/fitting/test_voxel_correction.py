"""The correction on voxels: restores detail lost by Gaussians, keeps what slices do not contradict, and reports it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_correction import VoxelCorrection, VoxelCorrectionSettings, correct_on_voxels
from g3r.fitting.voxel_problem import QUIET, too_fine
from g3r.geometry import VolumeGrid
from tests.fitting.scene import BALL, GRID, INDEX, make_slices, true_cloud, true_volume

SETTINGS = VoxelCorrectionSettings(n_iterations=20, loosens=False)
REACH = BALL.astype(np.float32)
CORE = (GRID.world(INDEX) ** 2).sum(-1) < 7.0**2
"""Voxels away from the rim, where slices end."""


def fit_of(gain: NDArray[np.float64] | None = None) -> SliceFit:
    """A fit whose poses and gains are true."""
    slices = make_slices(gain)
    ones = np.ones(len(slices))
    return SliceFit(
        cloud=true_cloud(), slices=slices, gain=ones if gain is None else gain, weight=ones, history=[], bias_field=[]
    )


def correction(
    volume: NDArray[np.float32],
    fit: SliceFit | None = None,
    settings: VoxelCorrectionSettings = SETTINGS,
    reach: NDArray[np.float32] = REACH,
) -> VoxelCorrection:
    fit = fit or fit_of()
    weight = fit.slices.mask.astype(np.float32)
    return correct_on_voxels(volume, volume, fit, weight, GRID, reach, settings, np.random.default_rng(0))


def rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt((values[CORE].astype(np.float64) ** 2).mean()))


def test_an_edge_that_is_too_soft_becomes_sharper() -> None:
    truth = true_volume()
    soft = gaussian_filter(truth, 0.8)
    found = correction(soft)
    assert rms(soft + found.values - truth) < 0.7 * rms(soft - truth)
    assert found.values.dtype == np.float16
    assert found.record.size == pytest.approx(float(np.sqrt((found.values[BALL].astype(float) ** 2).mean())), abs=1e-4)


def test_the_truth_stays_nearly_as_it_is() -> None:
    truth = true_volume()
    weak = replace(SETTINGS, total_variation=0.0)
    assert rms(correction(truth, settings=weak).values) < 0.02 * rms(truth)


def test_gains_and_fields_are_not_put_into_the_volume() -> None:
    gain = np.linspace(0.6, 1.6, 24)
    soft = gaussian_filter(true_volume(), 1.5)
    even, uneven = correction(soft).values, correction(soft, fit_of(gain)).values
    np.testing.assert_allclose(even, uneven, atol=0.01 * np.abs(even).max())


def test_voxels_out_of_reach_stay_as_they_are() -> None:
    soft, half = gaussian_filter(true_volume(), 1.5), REACH * (INDEX[..., 0] < 11)
    found = correction(soft, reach=half.astype(np.float32))
    assert not found.values[half == 0].any()
    assert (found.kept[half == 0] == 1).all()
    assert found.values[half > 0].any()


def test_kept_is_what_a_change_of_the_volume_leaves() -> None:
    """The reference is the change of the mixture with another prior volume."""
    soft = gaussian_filter(true_volume(), 0.8)
    change = np.random.default_rng(3).normal(size=GRID.shape)
    change = (0.02 * rms(soft) * gaussian_filter(change, 0.8) / gaussian_filter(change, 0.8).std()).astype(np.float32)
    one, two = (correction(start) for start in (soft, soft + change))
    after = change + two.values.astype(np.float64) - one.values
    left = float((after * change)[CORE].sum() / (change**2)[CORE].sum())
    assert 0.1 < left < 0.9
    assert left - 0.03 < one.kept[CORE].mean() < left + 0.15  # the estimate errs towards V_0


def test_a_weaker_pull_keeps_less() -> None:
    soft = gaussian_filter(true_volume(), 1.0)
    tight, loose = (correction(soft, settings=replace(SETTINGS, hold=hold)).kept[CORE].mean() for hold in (2.0, 0.2))
    assert loose < 0.6 * tight


def test_slices_without_weight_and_no_slices_correct_nothing() -> None:
    soft = gaussian_filter(true_volume(), 1.5)
    nothing = replace(fit_of(), weight=np.zeros(24))
    off = replace(SETTINGS, total_variation=0.0)
    assert np.abs(correction(soft, nothing, off).values).max() < 1e-3 * soft.max()


def test_fine_voxels_show_no_grid_of_pixels() -> None:
    """A uniform volume that is too dark for pixels of 1 mm becomes brighter almost uniformly."""
    fit = fit_of()
    slices = replace(fit.slices, value=np.full_like(fit.slices.value, 0.6))
    for voxel_mm, pattern in ((0.8, 0.1), (0.59, 0.25)):
        grid = VolumeGrid.isotropic([-11] * 3, [11] * 3, voxel_mm)
        inside = (grid.world(np.moveaxis(np.indices(grid.shape), 0, -1)) ** 2).sum(-1) < 7.0**2
        flat = np.full(grid.shape, 0.5, np.float32)
        found = correct_on_voxels(
            flat,
            flat,
            replace(fit, slices=slices),
            slices.mask.astype(np.float32),
            grid,
            inside.astype(np.float32),
            SETTINGS,
            np.random.default_rng(0),
        )
        values = found.values[inside].astype(np.float64)
        assert 0.05 < values.mean() < 0.1
        assert values.std() < pattern * values.mean()
    assert not too_fine(0.55, slices)
    assert too_fine(0.45, slices)


def test_the_noisier_the_slices_the_stronger_the_pull() -> None:
    by_noise = [SETTINGS.for_noise(noise) for noise in (0.0, QUIET, 2 * QUIET)]
    assert [one.hold for one in by_noise] == pytest.approx([SETTINGS.hold, SETTINGS.hold, 2 * SETTINGS.hold])
    assert by_noise[2].total_variation == pytest.approx(4 * SETTINGS.total_variation)
    truth, clean = true_volume(), fit_of(np.ones(24))
    noise = np.random.default_rng(4).normal(0, 3 * QUIET, len(clean.slices.value)).astype(np.float32)
    noisy = replace(clean, slices=replace(clean.slices, value=clean.slices.value + noise))
    assert correction(truth, noisy).record.hold == pytest.approx(3 * SETTINGS.hold, rel=0.1)


@pytest.mark.parametrize("n_stacks", [1, 3])
def test_what_a_single_stack_disagrees_by_is_noise_in_full(n_stacks: int) -> None:
    """One slice in eight is off, which hardly counts if other stacks check the poses."""
    fit, off = fit_of(np.ones(24)), 5 * QUIET
    sign = np.random.default_rng(5).choice([-off, off], len(fit.slices.value)).astype(np.float32)
    value = fit.slices.value + np.where(fit.slices.planes.plane_id() % 8 == 3, sign, 0)
    slices = replace(fit.slices, value=value, stack_id=np.minimum(fit.slices.stack_id, n_stacks - 1))
    expected = SETTINGS.hold * (5 / math.sqrt(8) if n_stacks == 1 else 1)
    assert correction(true_volume(), replace(fit, slices=slices)).record.hold == pytest.approx(expected, rel=0.25)
