"""Held-out slices detect profiles that are narrower or wider than stated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.planes import Slices
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.fit_context import FitContext
from g3r.fitting.held_out_prediction import HeldOutFit, lowest
from g3r.fitting.held_out_slices import HeldOutChoice, HeldOutSettings, ask_held_out_slices, held_out_rows
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.fitting.prior_targets import fit_to_prior
from g3r.fitting.prior_volume import prior_volume
from g3r.fitting.slice_stage import SliceStageSettings
from g3r.fitting.slice_targets import SliceModel, slice_target
from g3r.gaussians import GaussianCloud, render
from g3r.prior.maps import DEFAULT_TILING
from tests.fitting.scene import make_slices, true_cloud


def start(width: float) -> tuple[PriorVolume, GaussianCloud]:
    """V_sharp and its Gaussians, from slices whose through-plane profile is `width` times the stated one."""
    slices = make_slices()
    planes = replace(slices.planes, psf_var_mm2=slices.planes.psf_var_mm2 * [1, 1, width**2])
    slices = replace(slices, value=render(true_cloud(), planes, cutoff_sigma=6.0).numpy())
    ones = np.ones(len(slices))
    volumes = InitialVolumes.of(slices, ones, ones, 1.0, common_bias_field=False)
    prior = prior_volume(volumes, ones, ones, None, None, n_views=1, tiling=DEFAULT_TILING)
    return prior, cloud_of_prior(prior)


def cloud_of_prior(prior: PriorVolume) -> GaussianCloud:
    stage, context = PriorStageSettings(n_steps=10), FitContext(rng=np.random.default_rng(0))
    return fit_to_prior(prior, spacing_mm=2.0, stage=stage, context=context).cloud


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


def held_out_fit(cloud: GaussianCloud, slices: Slices) -> HeldOutFit:
    """Of slices that show brain alone, without a bias field."""
    ones = np.ones(len(slices.pixel_index), np.float32)
    return HeldOutFit(cloud, slices, ones, ones)


@pytest.mark.parametrize("width", [0.7, 1.3])
def test_the_width_of_the_profile_is_found(width: float) -> None:
    found = ask(*start(width))
    assert found.mean_width is not None
    assert found.widths is not None
    assert (found.mean_width < 0.92) if width < 1 else (found.mean_width > 1.08)
    taken = math.prod(found.widths) ** (1 / 3)  # the fit takes half the deviation from the nominal width
    assert abs(math.log(taken)) == pytest.approx(abs(math.log(found.mean_width)) / 2, abs=0.02)
    assert len(found.error) == 3
    assert found.n_slices >= 3


def test_each_stack_has_a_width_of_its_own() -> None:
    cloud, said = true_cloud(), make_slices()
    widths = np.array([0.75, 1.0, 1.25])
    factor = np.stack([np.ones(24), np.ones(24), widths[said.stack_id]], axis=1)
    planes = replace(said.planes, psf_var_mm2=said.planes.psf_var_mm2 * factor**2)
    slices = replace(said, value=render(cloud, planes, cutoff_sigma=6.0).numpy())
    fit = held_out_fit(cloud, slices)
    expected = widths / math.prod(widths) ** (1 / 3)
    np.testing.assert_allclose(fit.relative_widths(np.arange(3)), expected, rtol=0.03)
    few = slices.take(np.r_[0:2, 8:24])  # two slices of a stack say nothing
    of_few = held_out_fit(cloud, few)
    np.testing.assert_array_equal(of_few.relative_widths(np.arange(3)), 1)
    # a stack without held-out slices has a width too, because the fit takes one per stack
    without = slices.take(slices.stack_id != 1)
    of_two = held_out_fit(cloud, without)
    np.testing.assert_array_equal(of_two.relative_widths(np.arange(3)), np.ones(3))


def test_the_lowest_of_a_parabola_lies_between_the_widths() -> None:
    widths = (0.7, 0.85, 1.0, 1.2)
    assert lowest(widths, [(math.log(width / 0.9)) ** 2 + 1 for width in widths]) == pytest.approx(0.9)
    assert lowest(widths, [4.0, 3.0, 2.0, 1.0]) == pytest.approx(1.2, abs=0.15)  # not far beyond the tested widths
    assert lowest(widths, [1.0, 1.001, 1.0, 1.001]) is None


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


def test_the_error_is_after_one_gain_a_slice() -> None:
    cloud, slices = true_cloud(), make_slices(np.linspace(0.5, 2, 24))
    fit = held_out_fit(cloud, slices)
    assert fit.errors().mean() < 2e-3 * slices.value.max()  # the cut-off of the renderer
    assert fit.errors(1.3).mean() > 2 * fit.errors().mean()


def test_the_field_of_a_stack_is_no_error() -> None:
    cloud, slices = true_cloud(), make_slices()
    fields = StackBiasField(slices)
    field = np.exp(fields.log_field(np.full((len(fields.stacks), 5), 0.3)))
    shaded = replace(slices, value=slices.value * field)
    known = HeldOutFit(cloud, shaded, np.ones(len(slices.pixel_index), np.float32), field[slices.pixel_index])
    unknown = held_out_fit(cloud, shaded)
    assert known.errors().mean() < 2e-3 * shaded.value.max()
    assert unknown.errors().mean() > 3 * known.errors().mean()


def test_a_short_fit_hands_on_the_fields_it_found(monkeypatch: pytest.MonkeyPatch) -> None:
    prior, cloud = start(1.0)
    seen: list[float] = []
    errors = HeldOutFit.errors

    def noted(fit: HeldOutFit, stretch: float = 1.0) -> np.ndarray:
        seen.append(float(np.abs(np.log(fit.field)).max()))
        return errors(fit, stretch)

    monkeypatch.setattr(HeldOutFit, "errors", noted)
    ask(prior, cloud)
    assert max(seen) > 0


def test_the_slice_model_scales_the_profile_and_leaves_the_rest() -> None:
    prior, _ = start(1.0)
    ones = np.ones(len(prior.volumes.slices))
    model = SliceModel(through_plane=0.8, in_plane=1.1, surroundings=False)
    found = slice_target(prior, ones, model)
    before = prior.volumes.slices
    np.testing.assert_allclose(found.slices.planes.psf_var_mm2 / before.planes.psf_var_mm2, [[1.21, 1.21, 0.64]] * 24)
    np.testing.assert_array_equal(found.slices.value, before.value)
    np.testing.assert_array_equal(found.pixel_weight, before.mask)
    of_each = slice_target(prior, ones, model, [0.5, 0.6, 0.7])
    factor = of_each.slices.planes.psf_var_mm2 / before.planes.psf_var_mm2
    np.testing.assert_allclose(factor[:, 2], np.array([0.25, 0.36, 0.49])[before.stack_id])
    np.testing.assert_allclose(factor[:, :2], 1.21)
