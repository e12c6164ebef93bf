"""The volume check: a finished volume that explains the slices worse than V_prior is not written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from g3r.acquisition.coarse_volume import coarse_and_density
from g3r.acquisition.planes import Slices
from g3r.fitting import lattice_mean
from g3r.fitting.slice_stage import SliceFit, fit_slices
from g3r.fitting.volume_check import VolumeCheck, check_volume
from g3r.geometry.grid import on_grid
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from tests.fitting.scene import BALL, GRID, INDEX, make_slices, true_volume
from tests.numerics.fits import SETTINGS, small_stacks

ONES = np.ones(24)


def check(
    volume: NDArray[np.float32],
    prior: NDArray[np.float32],
    slices: Slices | None = None,
    weight: NDArray[np.float64] = ONES,
) -> VolumeCheck:
    slices = slices or make_slices()
    coarse = coarse_and_density(slices, GRID)[0]
    poses = {"slices": slices, "slices_before": slices}
    return check_volume(volume, prior, coarse, support=BALL, grid=GRID, weight=weight, **poses)


def test_residuals_rank_volumes_as_their_errors_do() -> None:
    truth = true_volume()
    noisy = (truth + 0.3 * truth.std() * np.random.default_rng(0).normal(size=truth.shape)).astype(np.float32)
    good, bad = check(truth, noisy), check(noisy, truth)
    assert not good.falls_back
    assert good.line() == ""
    assert bad.falls_back
    assert "worse" in bad.line()
    assert good.volume == bad.prior
    assert 0 < good.volume < 0.02 < good.prior
    assert good.coarse > good.volume  # V_coarse is blurred twice


def test_gains_and_units_do_not_matter() -> None:
    truth = true_volume()
    scaled = check(truth * np.float32(1e-6), truth, slices=make_slices(np.linspace(0.5, 2, 24)))
    assert scaled.volume == pytest.approx(check(truth, truth).volume, abs=0.003)


def test_bias_fields_of_the_slices_are_not_held_against_a_volume_without_them() -> None:
    """V_prior is made from biased slices and shows their bias, which the fit divides out."""
    slices, truth = make_slices(), true_volume()
    steepness = 0.03 * np.array([1.0, -0.3, 0.5])
    biased = slices.value * np.exp(slices.planes.pixel_world_mm() @ steepness).astype(np.float32)
    rng = np.random.default_rng(0)
    noisy = truth + 0.2 * truth.std() * rng.normal(size=truth.shape)
    with_bias = (noisy * np.exp(GRID.world(INDEX) @ steepness)).astype(np.float32)
    found = check(truth, with_bias, slices=replace(slices, value=biased))
    assert not found.falls_back
    assert found.volume < 0.05  # the fitted fields are of second order, but the true one is an exponential
    wrong = check(np.roll(truth, 2, 0), with_bias, slices=replace(slices, value=biased))
    assert wrong.falls_back


def test_slices_without_weight_do_not_count() -> None:
    truth, slices = true_volume(), make_slices()
    spoilt = replace(slices, value=slices.value.copy())
    middle = slices.planes.plane_id() == 4
    spoilt.value[middle] = spoilt.value[middle][::-1] + np.float32(1)
    assert check(truth, truth, slices=spoilt).volume > 0.1
    without = np.where(np.arange(24) == 4, 0.0, 1.0)
    clean = check(truth, truth, slices=slices, weight=without)
    assert check(truth, truth, slices=spoilt, weight=without).volume == clean.volume


def test_the_better_mean_of_the_slices_is_said() -> None:
    line = VolumeCheck(volume=0.2, prior=0.3, coarse=0.1).line()
    assert "mean of the slices" in line
    assert "registration" in line


def test_what_differs_by_less_than_the_check_can_tell_is_not_called_worse() -> None:
    tie = VolumeCheck(volume=0.0951, prior=0.0930, coarse=0.0925)
    assert not tie.falls_back
    assert tie.line() == ""
    assert VolumeCheck(volume=0.0951, prior=0.0920, coarse=0.2).falls_back
    assert VolumeCheck(volume=0.0951, prior=0.1, coarse=0.0920).line()


def reconstruction() -> ReconstructionResult:
    """Reconstruction of a small head with as many steps as `fast`."""
    settings = replace(SETTINGS, slice_stage=PRESETS["fast"].slice_stage, gaussian_spacing_pixels=1.5)
    return GaussianReconstructor(settings=settings).reconstruct(small_stacks())


def test_a_spoilt_fit_is_replaced_by_the_prior_volume(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = reconstruction()
    assert sound.record.volume_check is not None
    assert not sound.record.volume_check.falls_back

    def spoilt(*arguments: object, **options: object) -> SliceFit:
        fit = fit_slices(*arguments, **options)  # type: ignore[arg-type]
        return replace(fit, cloud=fit.cloud.with_amplitude(fit.cloud.amplitude.roll(7)))

    monkeypatch.setattr(lattice_mean, "fit_slices", spoilt)
    result = reconstruction()
    record = result.record
    assert record.volume_check is not None
    assert record.volume_check.falls_back
    assert record.prior_weight == 1.0
    assert any("made the volume worse" in one for one in record.warnings)
    assert result.prior_share is not None
    assert (result.prior_share[result.mask] == 1).all()
    prior = on_grid(result.prior, result.prior_grid, result.grid, outside=0.0)
    inside = result.mask & (result.volume != 0)
    assert np.allclose(result.volume[inside], prior[inside], rtol=1e-5, atol=1e-3 * prior.max())
