"""Held-out slices find a profile that is narrower or wider than stated, and tell a good prior from a bad one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.fitting.held_out_slices import HeldOutChoice, HeldOutSettings, Prediction, ask_held_out_slices, held_out_rows
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.fitting.prior_targets import fit_to_prior
from g3r.fitting.prior_volume import prior_volume
from g3r.fitting.slice_stage import SliceStageSettings
from g3r.fitting.slice_targets import SliceModel, slice_target
from g3r.gaussians import GaussianCloud, render
from g3r.prior.inference import DEFAULT_TILING
from tests.fitting.scene import make_slices, true_cloud


def start(width: float) -> tuple[PriorVolume, GaussianCloud]:
    """V_sharp and its Gaussians, of slices whose profile is `width` times what they say."""
    slices = make_slices()
    planes = replace(slices.planes, psf_var_mm2=slices.planes.psf_var_mm2 * width**2)
    slices = replace(slices, value=render(true_cloud(), planes, cutoff_sigma=6.0).numpy())
    ones = np.ones(len(slices))
    volumes = InitialVolumes.of(slices, ones, ones, 1.0, common_bias_field=False)
    prior = prior_volume(volumes, ones, None, None, n_views=1, tiling=DEFAULT_TILING)
    return prior, cloud_of_prior(prior)


def cloud_of_prior(prior: PriorVolume) -> GaussianCloud:
    rng = np.random.default_rng(0)
    stage = PriorStageSettings(n_steps=10)
    found = fit_to_prior(prior, spacing_mm=2.0, stage=stage, rng=rng, progress=lambda *_: None, deadline=None)
    return found.cloud


def ask(prior: PriorVolume, cloud: GaussianCloud) -> HeldOutChoice:
    return ask_held_out_slices(
        cloud,
        prior,
        np.ones(len(prior.volumes.slices)),
        distillation=False,
        model=SliceModel(surroundings=False),
        stage=SliceStageSettings(),
        settings=HeldOutSettings(slab=1.0, n_steps=40),
        rng=np.random.default_rng(0),
    )


@pytest.mark.parametrize("width", [0.7, 1.3])
def test_the_width_of_the_profile_is_found(width: float) -> None:
    found = ask(*start(width))
    assert found.width is not None
    assert (found.width < 0.95) if width < 1 else (found.width > 1.05)
    assert len(found.error) == 3
    assert found.n_slices >= 3


def test_a_good_prior_gets_weight_and_a_bad_one_none() -> None:
    prior, _ = start(1.0)
    grid = prior.volumes.grid
    world = grid.world(np.moveaxis(np.indices(grid.shape), 0, -1))
    wrong = replace(prior, values=(prior.values + 0.5 * np.sin(world.sum(-1)) * prior.support).astype(np.float32))
    assert ask(wrong, cloud_of_prior(wrong)).prior_weight == 0
    noise = np.random.default_rng(0).normal(0, 0.2, prior.volumes.slices.value.shape).astype(np.float32)
    slices = replace(prior.volumes.slices, value=prior.volumes.slices.value + noise)
    noisy = replace(prior, volumes=replace(prior.volumes, slices=slices))
    weight = ask(noisy, cloud_of_prior(noisy)).prior_weight
    assert weight is not None
    assert weight > 0.6


def test_too_few_slices_choose_nothing() -> None:
    prior, cloud = start(1.0)
    slices = prior.volumes.slices.take(np.arange(4))
    few = replace(prior, volumes=replace(prior.volumes, slices=slices), gain=np.ones(4))
    found = ask(few, cloud)
    assert found == HeldOutChoice(error={})


def test_distrusted_slices_are_not_asked() -> None:
    slices = make_slices()
    weight = np.ones(len(slices))
    held = held_out_rows(slices, weight)
    assert 1 <= held[slices.stack_id == 0].sum() <= 2
    weight[held] = 0.1
    assert not held_out_rows(slices, weight).any()


def test_the_error_of_a_mixture_is_after_one_gain_a_slice() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 1, 40).astype(np.float32)
    number = np.repeat([0, 1], 20)
    gain = np.where(number == 0, 0.7, 1.4).astype(np.float32)
    off = (truth + rng.normal(0, 0.2, 40)).astype(np.float32)
    predicted = Prediction(truth * gain, truth, off, number, np.ones(40, np.float32))
    assert predicted.error(0.0) == pytest.approx(0, abs=1e-6)
    assert 0 < predicted.error(0.5) < predicted.error(1.0)


def test_the_slice_model_scales_the_profile_and_leaves_the_rest() -> None:
    prior, _ = start(1.0)
    ones = np.ones(len(prior.volumes.slices))
    model = SliceModel(through_plane=0.8, in_plane=1.1, surroundings=False)
    found = slice_target(prior, ones, model)
    before = prior.volumes.slices
    np.testing.assert_allclose(found.slices.planes.psf_var_mm2 / before.planes.psf_var_mm2, [[1.21, 1.21, 0.64]] * 24)
    np.testing.assert_array_equal(found.slices.value, before.value)
    np.testing.assert_array_equal(found.pixel_weight, before.mask)
    assert model.of_width(None) is model
    assert model.of_width(0.7) == SliceModel(through_plane=0.7, in_plane=0.7, surroundings=False)
