"""Extreme fits: degenerate input, divergence, and changes that should have no effect."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from g3r.acquisition.planes import Slices
from g3r.errors import InputError, NumericalError
from g3r.fitting import divergence_guard as divergence_guard
from g3r.fitting import prior_stage
from g3r.fitting.divergence_guard import DivergenceGuard
from g3r.fitting.fit_context import FitContext
from g3r.fitting.parameters import FitParameters, LearningRates
from g3r.fitting.prior_stage import PriorStageSettings, VolumeTarget, fit_prior
from g3r.fitting.schedules import AnnealedWeight
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings, fit_slices
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.seeding import seed_cloud
from tests.numerics.fits import fit_at, slices_of_small_head, step_size_rows, times, volume_changes
from tests.numerics.scenes import head_scene, single
from tests.tally import Tally


def fit(cloud: GaussianCloud, slices: Slices, prior: VolumeTarget | None = None, **options: Any) -> SliceFit:
    ones = np.ones(len(slices))
    settings = SliceStageSettings(**({"n_steps": 25, "reweight_every": 10} | options))
    return fit_slices(cloud, slices, gain=ones, weight=ones, prior=prior, settings=settings, context=context())


def context() -> FitContext:
    return FitContext(rng=np.random.default_rng(0))


def seeded() -> GaussianCloud:
    _, grid, guess, mask = slices_of_small_head()
    return seed_cloud(guess, mask, grid, 2.8)


def assert_finite(result: SliceFit) -> None:
    for p in result.cloud.parameters:
        assert torch.isfinite(p).all()
    for array in (result.gain, result.weight, result.slices.planes.rotation, result.slices.planes.center_mm):
        assert np.isfinite(array).all()
    assert np.isfinite([value for entry in result.history for value in entry.values()]).all()
    assert np.isfinite(np.array(result.bias_field, dtype=float)).all()
    assert torch.isfinite(render(result.cloud, result.slices.planes)).all()


def constant(value: float) -> Slices:
    slices = slices_of_small_head()[0]
    return replace(slices, value=np.full_like(slices.value, value))


def with_mask(pixels: slice | list[int]) -> Slices:
    slices = slices_of_small_head()[0]
    mask = np.zeros_like(slices.mask)
    mask[np.flatnonzero(slices.mask)[pixels]] = True
    return replace(slices, mask=mask)


def turned_on_themselves() -> Slices:
    """All slices of a stack at the same place."""
    slices = slices_of_small_head()[0]
    center = slices.planes.center_mm.copy()
    center[:] = center.mean(0)
    return replace(slices, planes=replace(slices.planes, center_mm=center))


DEGENERATE = {
    "constant slices": lambda: (seeded(), constant(0.5)),
    "slices of zeros": lambda: (seeded(), constant(0.0)),
    "negative slices": lambda: (seeded(), constant(-0.5)),
    "slices times 1e-6": lambda: (seeded(), slices_of_small_head()[0].scaled(1e-6)),
    "slices times 1e6": lambda: (seeded(), slices_of_small_head()[0].scaled(1e6)),
    "one slice": lambda: (seeded(), slices_of_small_head()[0].take([5])),
    "one pixel": lambda: (seeded(), with_mask([100])),
    "no pixel": lambda: (seeded(), with_mask(slice(0, 0))),
    "slices in one place": lambda: (seeded(), turned_on_themselves()),
    "one Gaussian": lambda: (seeded().take(torch.tensor([40])), slices_of_small_head()[0]),
    "no Gaussian": lambda: (seeded().take(torch.arange(0)), slices_of_small_head()[0]),
    "identical Gaussians": lambda: (seeded().take(torch.tensor([40] * 30)), slices_of_small_head()[0]),
    "Gaussians as large as the head": lambda: (grown(seeded(), 3.0), slices_of_small_head()[0]),
    "Gaussians far below a pixel": lambda: (grown(seeded(), -4.5), slices_of_small_head()[0]),
    "Gaussians beside the slices": lambda: (shifted(seeded(), 300.0), slices_of_small_head()[0]),
    "amplitudes of zero": lambda: (seeded().with_amplitude(torch.zeros(len(seeded()))), slices_of_small_head()[0]),
}


def grown(cloud: GaussianCloud, by: float) -> GaussianCloud:
    return GaussianCloud.of([cloud.mean_mm, cloud.log_scale + by, *cloud.parameters[2:]], cloud.origin_mm)


def shifted(cloud: GaussianCloud, by_mm: float) -> GaussianCloud:
    return GaussianCloud.of([cloud.mean_mm + by_mm, *cloud.parameters[1:]], cloud.origin_mm)


@pytest.mark.parametrize("amplitudes_first", [True, False])
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_fits_end_in_finite_numbers(name: str, amplitudes_first: bool, tally: Tally) -> None:
    cloud, slices = DEGENERATE[name]()
    with tally.case():
        result = fit(cloud, slices, n_steps=15, amplitude_iterations=6 if amplitudes_first else 0)
        assert_finite(result)


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_a_prior_stage_on_scaled_volumes_is_the_same_scaled(factor: float, tally: Tally) -> None:
    _, grid, _, mask = slices_of_small_head()
    cloud = single(head_scene(np.zeros(3)).cloud)
    from g3r.acquisition.planes import volume_from_pixels, volume_planes

    volume = volume_from_pixels(render(cloud, volume_planes(grid)).numpy(), grid)
    fitted = []
    for scale in (1.0, factor):
        target = VolumeTarget.of(volume * np.float32(scale), mask.astype(np.float32), grid)
        with tally.case():
            start = seed_cloud(volume, mask, grid, 2.8)
            start = start.with_amplitude(start.amplitude * scale)
            found, _ = fit_prior(start, target, PriorStageSettings(n_steps=0), context())
            fitted.append(found.amplitude / scale)
    assert torch.equal(*fitted)


# -- step sizes that are too large -----------------------------------------------------------------


@pytest.mark.parametrize("factor", [10.0, 100.0])
def test_steps_that_are_too_large_are_taken_back(factor: float, tally: Tally, caplog: pytest.LogCaptureFixture) -> None:
    plain = fit_at(1.0, n_steps=40)
    with tally.case():
        rash = fit_at(factor, n_steps=40)
        assert_finite(rash)

    def residual(result: SliceFit) -> float:
        return result.history[-1]["image"]  # includes gains, whose steps were too large as well

    assert rash.n_rollbacks > 0
    assert "back to the best state" in caplog.text
    assert residual(rash) < rash.history[0]["image"]
    assert residual(rash) < 1.5 * residual(plain)


def test_without_the_safeguard_they_end_worse_or_not_at_all() -> None:
    image = [entry["image"] for entry in fit_at(100.0, guarded=False, n_steps=40).history]
    assert image[-1] > 5 * image[0]
    with pytest.raises(NumericalError):
        fit_at(300.0, guarded=False)


def test_a_fit_that_goes_well_takes_the_same_steps_with_the_safeguard() -> None:
    with_it, without = fit_at(1.0, n_steps=25), fit_at(1.0, guarded=False, n_steps=25)
    assert with_it.history == without.history
    for a, b in zip(with_it.cloud.parameters, without.cloud.parameters, strict=True):
        assert torch.equal(a, b)


def test_stage_1_steps_back_as_well(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    _, grid, _, mask = slices_of_small_head()
    from g3r.acquisition.planes import volume_from_pixels, volume_planes

    cloud = single(head_scene(np.zeros(3)).cloud)
    volume = volume_from_pixels(render(cloud, volume_planes(grid)).numpy(), grid)
    target = VolumeTarget.of(volume, mask.astype(np.float32), grid)
    monkeypatch.setattr(prior_stage, "LearningRates", lambda: times(30.0))
    found, loss = fit_prior(seed_cloud(volume, mask, grid, 2.8), target, PriorStageSettings(n_steps=40), context())
    assert "back to the best state" in caplog.text
    assert np.isfinite(loss).all()
    assert loss[-1] < 2 * loss[0]
    left = np.abs(render(found, target.planes).numpy() - target.value)[target.weight > 0].mean()
    assert left < 2 * loss[0]


def one_gaussian() -> FitParameters:
    cloud = GaussianCloud.of(
        [torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1,), 2.0)], np.zeros(3)
    )
    return FitParameters(cloud, LearningRates())


@pytest.mark.parametrize("bad", [math.nan, math.inf, 100.0])
def test_a_bad_loss_brings_the_best_state_back_with_shorter_steps(bad: float) -> None:
    parameters = one_gaussian()
    parameters.gradients[:] = 1.0
    guard = DivergenceGuard(parameters, level=1.0)
    best = parameters.values.copy()
    assert guard.step(0.5, 1.0)
    assert not np.array_equal(parameters.values, best)
    assert not guard.step(bad, 1.0)
    assert np.array_equal(parameters.values, best)
    assert guard.step_factor == divergence_guard.SHORTER
    assert guard.n_back == 1
    assert guard.step(0.5, 1.0)
    shorter = np.abs(parameters.values - best).max()
    parameters.restart(best)
    parameters.gradients[:] = 1.0
    parameters.step(0.5, 1.0)
    assert shorter == pytest.approx(divergence_guard.SHORTER * np.abs(parameters.values - best).max(), rel=1e-4)


def test_a_bad_gradient_after_good_steps_goes_back_and_one_at_the_start_is_an_error() -> None:
    parameters = one_gaussian()
    guard = DivergenceGuard(parameters, level=1.0)
    best = parameters.values.copy()
    assert guard.step(0.5, 1.0)
    parameters.gradients[2] = np.nan
    assert not guard.step(0.4, 1.0)
    assert np.array_equal(parameters.values, best)
    parameters.gradients[2] = np.nan
    with pytest.raises(NumericalError):
        DivergenceGuard(parameters, level=1.0).step(0.5, 1.0)


def test_a_fit_ends_at_its_best_state_if_it_never_came_back_to_it() -> None:
    parameters = one_gaussian()
    parameters.gradients[:] = 1.0
    guard = DivergenceGuard(parameters, level=1.0)
    best = parameters.values.copy()
    guard.step(0.5, 1.0)
    guard.step(5.0, 1.0)
    guard.step(0.6, 1.0)
    guard.finish()
    assert np.array_equal(parameters.values, best)


def test_a_small_rise_is_no_reason_to_go_back() -> None:
    parameters = one_gaussian()
    guard = DivergenceGuard(parameters, level=1.0)
    assert guard.step(0.010, 1.0)
    assert guard.step(0.100, 1.0)  # ten times larger, but negligible against the pixels
    assert guard.step(0.159, 1.0)
    guard.rescale(0.5)
    assert not guard.step(0.159, 1.0)


# -- schedules, and what changes nothing -----------------------------------------------------------


@pytest.mark.parametrize("tau", [(0.8, 0.2), (-0.1, 0.5), (0.5, 1.1), (math.nan, 0.5), (0.5, math.inf)])
def test_annealing_outside_or_reversed_is_refused(tau: tuple[float, float], tally: Tally) -> None:
    with tally.refusal():
        AnnealedWeight(0.5, 0.1, *tau)
    with pytest.raises(InputError, match="tau_1"):
        AnnealedWeight(0.5, 0.1, *tau)


@pytest.mark.parametrize("tau", [0.0, 0.5, 1.0])
def test_annealing_in_one_step_fits(tau: float, tally: Tally) -> None:
    _, grid, guess, mask = slices_of_small_head()
    prior = VolumeTarget.of(guess, mask.astype(np.float32), grid)
    with tally.case():
        result = fit(
            seeded(),
            slices_of_small_head()[0],
            prior,
            n_steps=10,
            prior_error=0.0,
            distillation=AnnealedWeight(0.5, 0.1, tau, tau),
        )
        assert_finite(result)
        weights = [entry["distillation_weight"] for entry in result.history]
        assert weights == [0.5 if n / 10 < tau else 0.1 for n in range(10)]


@pytest.mark.numerics
def test_the_table_of_step_sizes(tally: Tally) -> None:
    rows = step_size_rows()
    for row in rows:
        if row["guarded"]:
            with tally.case():
                assert np.isfinite(row["residual"])
                assert (row["back"] > 0) == (row["factor"] > 1)
                assert row["residual"] < 1.5 * rows[0]["residual"]
        elif row["factor"] == 1:
            assert row["residual"] == rows[0]["residual"]
        else:
            assert not row["residual"] < 1.2 * rows[0]["residual"]


@pytest.mark.numerics
def test_the_table_of_changes_that_change_nothing(tally: Tally) -> None:
    rows = {row["change"]: row for row in volume_changes()}
    plain = rows["none"]["error"]
    for name, row in rows.items():
        with tally.case():
            if "2^" in name:
                assert row["largest"] == 0, name  # scaling by a power of two is exact
            elif "times" in name:
                # rounding decides which voxels at the rim belong to the brain, and so where Gaussians are placed
                assert row["mean"] < 0.5 * plain, name
            elif "shifted" in name:
                assert row["mean"] < 0.002, name
            elif "turned" in name:
                assert row["mean"] < 1.5 * plain, name  # two fits with independent errors
            assert abs(row["error"] - plain) < 0.25 * plain, name
