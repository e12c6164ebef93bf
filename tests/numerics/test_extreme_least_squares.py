"""Undetermined amplitudes, densities from zero to a million, and failures of naive formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from g3r.acquisition.coarse_volume import coarse_and_density, confidence
from g3r.gaussians import GaussianCloud, render, solve_amplitudes
from g3r.gaussians.amplitudes import AmplitudeSystem
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.gate import DensityGate, confidence_from_density
from g3r.prior.inputs import PriorInputs
from tests.gradients import gradient_of
from tests.numerics.oracles import naive_amplitudes, naive_render
from tests.numerics.scenes import head_scene, single, slender_scenes
from tests.tally import Tally


def copies(n: int) -> tuple[GaussianCloud, GaussianCloud]:
    """A cloud, and the same with n copies of every Gaussian, so that the rank is one n-th of the size."""
    cloud = single(head_scene().cloud)
    return cloud, cloud.take(torch.arange(len(cloud)).repeat(n))


@pytest.mark.parametrize("damping", [0.0, 1e-3])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_identical_gaussians_share_the_peak(n: int, damping: float, tally: Tally) -> None:
    """Conjugate gradients from zero give the least-squares solution of smallest norm: equal shares."""
    planes = head_scene().planes
    cloud, several = copies(n)
    target, ones = render(cloud, planes).numpy(), np.ones(planes.n_pixels, np.float32)
    with tally.case():
        start = several.with_amplitude(torch.zeros(len(several)))
        found = solve_amplitudes(start, planes, target, ones, n_iterations=40, damping=damping).amplitude
        shares = found.reshape(n, -1)
        assert torch.isfinite(found).all()
        assert (shares - shares[0]).abs().max() < 1e-5
        residual = np.abs(render(several.with_amplitude(found), planes).numpy() - target).max()
        assert residual < (0.02 if damping else 1e-3) * target.max()


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_more_gaussians_than_pixels(damping: float, tally: Tally) -> None:
    scene = head_scene()
    planes = scene.planes.take([4])
    planes = replace(planes, spacing_mm=planes.spacing_mm * 6, shape=np.array([[3, 3]]))
    target = np.linspace(0.1, 1, 9).astype(np.float32)
    with tally.case():
        start = single(scene.cloud)
        found = solve_amplitudes(start, planes, target, np.ones(9, np.float32), n_iterations=60, damping=damping)
        assert torch.isfinite(found.amplitude).all()
        assert np.abs(render(found, planes).numpy() - target).max() < (0.2 if damping else 5e-3)


@pytest.mark.parametrize("factor", [1e-6, 2.0**-20, 2.0**20, 1e6])
def test_peaks_scale_with_the_intensities(factor: float, tally: Tally) -> None:
    planes, cloud = head_scene().planes, single(head_scene().cloud)
    target = render(cloud, planes).numpy() + np.random.default_rng(0).normal(0, 0.1, planes.n_pixels)
    ones = np.ones(planes.n_pixels, np.float32)
    start = cloud.with_amplitude(torch.zeros(len(cloud)))
    plain = solve_amplitudes(start, planes, target.astype(np.float32), ones).amplitude
    with tally.case():
        scaled = solve_amplitudes(start, planes, target.astype(np.float32) * np.float32(factor), ones).amplitude
        change = (scaled.double() / factor - plain.double()).abs().max()
        assert change <= (0 if np.log2(factor).is_integer() else 1e-4) * plain.abs().max()


@pytest.mark.parametrize("factor", [0.0, 1e-20, 1e-6, 1e6])
def test_weights_of_any_size(factor: float, tally: Tally) -> None:
    planes, cloud = head_scene().planes, single(head_scene().cloud)
    target = render(cloud, planes).numpy()
    start = cloud.with_amplitude(torch.zeros(len(cloud)))
    with tally.case():
        weight = np.full(planes.n_pixels, factor, np.float32)
        found = solve_amplitudes(start, planes, target, weight, n_iterations=30).amplitude
        assert torch.isfinite(found).all()
        if factor:
            unit = solve_amplitudes(start, planes, target, weight / np.float32(factor), n_iterations=30).amplitude
            assert (found - unit).abs().max() < 2e-3
        else:
            assert (found == 0).all()


def test_an_epsilon_in_the_denominator_of_peaks_has_a_hidden_unit() -> None:
    """Sums over a narrow Gaussian are small, so the epsilon dominates the naive amplitude but not ours."""
    cloud = GaussianCloud.of(
        [torch.zeros(1, 3), torch.full((1, 3), float(np.log(0.02))), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1)],
        head_scene().cloud.origin_mm,
    )
    planes = head_scene().planes.take([4, 5])
    shown = AmplitudeSystem(cloud, planes).forward(np.ones(1, np.float32))
    matrix = shown[:, None].astype(np.float32)
    assert 0 < matrix.sum() < 1e-4
    target = np.full(planes.n_pixels, 1.0, np.float32)
    naive = [float(naive_amplitudes(matrix, target, epsilon)[0]) for epsilon in (0.0, 1e-8, 1e-4)]
    assert naive[0] == pytest.approx(1.0)
    assert naive[2] < 0.6  # an epsilon that affects no other Gaussian
    start = cloud.with_amplitude(torch.zeros(1))
    found = [
        solve_amplitudes(start, planes, shown * factor, np.full(planes.n_pixels, weight, np.float32), damping=0.0)
        for factor, weight in ((1.0, 1.0), (1.0, 1e-4), (1e-4, 1.0))
    ]
    for c, expected in zip(found, (1.0, 1.0, 1e-4), strict=True):
        assert float(c.amplitude) == pytest.approx(expected, rel=1e-4)


def test_determinant_and_inverse_fail_where_the_renderer_does_not() -> None:
    """The usual formula in float32 has an error of 0.3 % at a ratio of 100 and gives no number at 1000."""
    errors: dict[tuple[str, float], float] = {}
    for ratio in (100.0, 1000.0):
        for scene in slender_scenes(ratio, 20.0, False, 6):
            exact = render(scene.cloud, scene.planes, backend="reference")
            for name, found in (
                ("naive", naive_render(scene.cloud, scene.planes, torch.float32)),
                ("numba", render(single(scene.cloud), scene.planes, cutoff_sigma=6.0)),
            ):
                error = float((found - exact).abs().max() / exact.max()) if found.isfinite().all() else np.inf
                errors[name, ratio] = max(errors.get((name, ratio), 0.0), error)
    assert errors["naive", 100.0] > 1e-3
    assert errors["naive", 1000.0] == np.inf
    assert errors["numba", 100.0] < 2e-5
    assert errors["numba", 1000.0] < 2e-4


# -- density and its gate --------------------------------------------------------------------------

DENSITIES = [0.0, 1e-45, 1e-30, 1e-8, 1e-3, 1.0, 20.0, 1e3, 1e6, 3e38]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16])
def test_the_gate_at_every_density(dtype: torch.dtype, tally: Tally) -> None:
    gate = DensityGate()
    for density in DENSITIES:
        with tally.case():
            m = torch.tensor([density], dtype=dtype, requires_grad=True)
            value = gate(m)
            value.sum().backward()
            value, m_grad = value.detach(), gradient_of(m)
            assert torch.isfinite(value).all()
            assert torch.isfinite(m_grad).all()
            # alpha and beta are themselves rounded to half precision
            slack = float(torch.finfo(dtype).eps)
            assert gate.alpha - slack <= float(value) <= gate.beta + slack
            assert -1 <= float(m_grad) <= 0
            assert 0 <= float(confidence_from_density(m.detach())) <= 1


def test_confidence_keeps_its_digits_where_the_naive_form_has_none() -> None:
    m = np.float32(1e-8)
    assert confidence(np.array([m]))[0] == pytest.approx(1e-8, rel=1e-6)
    assert np.float32(1) - np.exp(-m) == 0
    assert float(confidence_from_density(torch.tensor(1e-8))) == pytest.approx(1e-8, rel=1e-6)


@pytest.mark.parametrize("density", [0.0, 1e-30, 1.0, 1e6])
def test_the_prior_network_at_every_density(density: float, tally: Tally) -> None:
    torch.manual_seed(0)
    config = PriorNetworkConfig(channels=(4, 8), units=(1, 1), tail_channels=2, use_sharp=False, use_template=False)
    network = DensityGatedPriorNetwork(config)
    torch.nn.init.normal_(network.refiner.head.weight)
    coarse = torch.rand(1, 1, 8, 8, 8)
    m = torch.full_like(coarse, density).requires_grad_()
    with tally.case():
        found = network(PriorInputs(coarse=coarse, density=m))
        (found.volume + found.brain_logit).sum().backward()
        assert torch.isfinite(found.volume).all()
        assert torch.isfinite(found.brain_logit).all()
        assert torch.isfinite(gradient_of(m)).all()
        assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)


@pytest.mark.parametrize("factor", [0.0, 1e-30, 1e-6, 1.0, 1e6])
def test_density_and_coarse_volume_at_any_trust(factor: float, tally: Tally) -> None:
    """V_coarse is a mean, so the scale of the weights cancels, down to where a voxel counts as not measured."""
    from tests.numerics.fits import slices_of_small_head

    slices, grid, *_ = slices_of_small_head(noise=0.0)
    weight = np.full(len(slices.pixel_index), factor)
    plain, density = coarse_and_density(slices, grid)
    with tally.case():
        coarse, thin = coarse_and_density(slices, grid, weight=weight)
        assert np.isfinite(coarse).all()
        assert np.isfinite(thin).all()
        np.testing.assert_allclose(thin, density * factor, rtol=1e-5, atol=1e-37)
        seen = thin > 1e-3
        assert (coarse[~seen] == 0).all()
        np.testing.assert_allclose(coarse[seen & (density > 1e-2)], plain[seen & (density > 1e-2)], rtol=1e-4)
