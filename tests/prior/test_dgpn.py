import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inputs import CERTAIN_LOGIT, PriorInputs
from g3r.prior.network import ResidualRefiner
from tests.gradients import gradient_of
from tests.prior.receptive_field import receptive_radius_voxels

SMALL = PriorNetworkConfig(channels=(8, 8, 8), units=(1, 1, 1), tail_channels=4, use_sharp=False, use_template=False)


@pytest.fixture
def given() -> PriorInputs:
    generator = torch.Generator().manual_seed(0)
    v_coarse = torch.rand(2, 1, 16, 16, 16, generator=generator)
    return PriorInputs(coarse=v_coarse, density=3 * torch.rand(v_coarse.shape, generator=generator))


def awaken(network: DensityGatedPriorNetwork) -> DensityGatedPriorNetwork:
    """Set random weights in the zero-initialised last convolution, so that F is not zero."""
    torch.manual_seed(1)
    nn.init.normal_(network.refiner.head.weight, std=0.02)
    return network.eval()


class Stub(nn.Module):
    """An F with known values, V + 10 M, and a brain logit of 7 V."""

    def forward(self, given: PriorInputs) -> tuple[torch.Tensor, torch.Tensor]:
        return given.coarse + 10 * given.density, 7 * given.coarse


@pytest.mark.parametrize(("alpha", "beta"), [(0.05, 1.0), (0.0, 0.5), (1.0, 1.0)])
def test_equation_7_with_a_known_residual(given: PriorInputs, alpha: float, beta: float) -> None:
    v_coarse, m_rho = given.coarse.double(), given.density.double()
    network = DensityGatedPriorNetwork(replace(SMALL, alpha=alpha, beta=beta))
    network.register_module("refiner", Stub())
    c = 1 - torch.exp(-m_rho)
    expected = v_coarse + (alpha * c + beta * (1 - c)) * (v_coarse + 10 * m_rho)
    found = network(PriorInputs(coarse=v_coarse, density=m_rho))
    torch.testing.assert_close(found.volume, expected, rtol=1e-14, atol=1e-14)
    # the gate acts on intensities only; the network decides what is brain at any density
    torch.testing.assert_close(found.brain_logit, CERTAIN_LOGIT + 7 * v_coarse, rtol=1e-14, atol=1e-14)


def test_gate_can_be_left_out(given: PriorInputs) -> None:
    network = DensityGatedPriorNetwork(replace(SMALL, use_gate=False))
    network.register_module("refiner", Stub())
    torch.testing.assert_close(network(given).volume, 2 * given.coarse + 10 * given.density)


def test_training_starts_from_the_coarse_volume(given: PriorInputs) -> None:
    assert torch.equal(DensityGatedPriorNetwork(SMALL)(given).volume, given.coarse)


@pytest.mark.parametrize("use_density", [True, False])
def test_residual_depends_on_density_and_share_only_if_it_may(given: PriorInputs, use_density: bool) -> None:
    refiner = awaken(DensityGatedPriorNetwork(replace(SMALL, use_density=use_density))).refiner
    for other in (replace(given, density=0 * given.density), replace(given, share=0 * given.density)):
        same = torch.equal(refiner(given)[0], refiner(other)[0])
        assert same is not use_density


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 9, 13), (8, 8, 8), (3, 33, 17), (24, 1, 25)])
def test_any_shape_works(shape: tuple[int, int, int]) -> None:
    network = awaken(DensityGatedPriorNetwork(SMALL))
    v_coarse = torch.rand(1, 1, *shape)
    found = network(PriorInputs(coarse=v_coarse, density=torch.ones_like(v_coarse)))
    for one in found:
        assert one.shape == v_coarse.shape
        assert bool(one.isfinite().all())


def test_one_level_works(given: PriorInputs) -> None:
    network = awaken(DensityGatedPriorNetwork(replace(SMALL, channels=(8,), units=(1,))))
    assert not torch.equal(network(given).volume, given.coarse)


def test_samples_of_a_batch_do_not_see_each_other(given: PriorInputs) -> None:
    network = awaken(DensityGatedPriorNetwork(SMALL))
    first = PriorInputs(coarse=given.coarse[:1], density=given.density[:1])
    alone, together = network(first).volume, network(given).volume[:1]
    # Rounding of float32 sums of a few hundred terms of size 1; batch statistics would show at 1e-2.
    torch.testing.assert_close(alone, together, rtol=0, atol=2e-5)


def test_density_of_0_and_1e6_gives_finite_values_and_gradients(given: PriorInputs) -> None:
    v_coarse = given.coarse.clone().requires_grad_()
    m_rho = torch.zeros_like(v_coarse)
    m_rho[:, :, :8] = 1e6
    network = awaken(DensityGatedPriorNetwork(SMALL))
    found = network(PriorInputs(coarse=v_coarse, density=m_rho))
    (found.volume.square().sum() + found.brain_logit.square().sum()).backward()
    gradients = [gradient_of(leaf) for leaf in (v_coarse, *network.parameters())]
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


def test_activations_keep_their_size_at_the_start() -> None:
    """Without normalisation layers, only the initial weights control the scale."""
    torch.manual_seed(0)
    refiner = ResidualRefiner(PriorNetworkConfig(use_sharp=False, use_template=False))
    seen = []
    for units in [*refiner.encoder, *refiner.decoder]:
        units.register_forward_hook(lambda module, inputs, output: seen.append(float(output.detach().std())))
    refiner(PriorInputs(coarse=torch.rand(1, 1, 32, 32, 32), density=torch.rand(1, 1, 32, 32, 32)))
    assert 0.2 < min(seen) <= max(seen) < 5.0, seen


def test_default_network_is_small_enough_to_ship() -> None:
    n_bytes = sum(4 * parameter.numel() for parameter in DensityGatedPriorNetwork(PriorNetworkConfig()).parameters())
    assert n_bytes < 20e6


def test_receptive_radius_is_an_upper_bound() -> None:
    refiner = awaken(DensityGatedPriorNetwork(SMALL)).refiner
    extent, center = 160, 80
    v_coarse = torch.rand(1, 1, extent, 8, 8).requires_grad_()
    residual, logit = refiner(PriorInputs(coarse=v_coarse, density=torch.ones_like(v_coarse)))
    (residual + logit)[0, 0, center].sum().backward()
    reached = gradient_of(v_coarse).abs().sum((0, 1, 3, 4)).nonzero().flatten()
    reach = max(center - int(reached.min()), int(reached.max()) - center)
    assert receptive_radius_voxels(SMALL) // 2 < reach <= receptive_radius_voxels(SMALL)


@pytest.mark.parametrize(
    "wrong",
    [
        {"channels": ()},
        {"units": (1, 1)},
        {"channels": (8, 0, 8)},
        {"channels": (8, 5000, 8)},
        {"units": (1, 65, 1)},
        {"tail_channels": 0},
    ],
)
def test_networks_without_meaning_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="one positive entry per level"):
        replace(SMALL, **wrong)


def test_a_base_that_is_not_shown_is_refused() -> None:
    with pytest.raises(ValueError, match="sharp_base needs use_sharp"):
        replace(SMALL, sharp_base=True)


@pytest.mark.parametrize(
    "wrong", [{"template_shape": (2, 2, 2)}, {"template_shape": (1, 2, 600, 2)}, {"template_spacing_mm": 0.0}]
)
def test_templates_without_meaning_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="template of"):
        replace(SMALL, **wrong)


def test_a_template_of_any_shape_is_taken_as_it_will_be_stored() -> None:
    network = DensityGatedPriorNetwork(SMALL)
    network.set_template(torch.full((2, 3, 4, 5), 1 / 3))
    assert network.config.template_shape == (2, 3, 4, 5)
    assert network.template.dtype == torch.float32
    assert torch.equal(network.template, torch.full((2, 3, 4, 5), 1 / 3).half().float())
    np.testing.assert_allclose(network.config.template_grid.center_mm, 0, atol=1e-9)


@pytest.mark.parametrize("n", [4, 13, 25, 30, 49, 60])
def test_the_template_s_grid_has_its_shape(n: int) -> None:
    """This holds however (n - 1) times 1.6 is rounded."""
    grid = replace(SMALL, template_shape=(1, n, 5, 4), template_spacing_mm=1.6).template_grid
    assert grid.shape == (n, 5, 4)
    np.testing.assert_allclose(grid.world([0, 0, 0]), -0.8 * np.array([n - 1, 4, 3]), atol=1e-9)


def test_importing_the_package_stays_light() -> None:
    code = (
        "import sys, g3r.prior, g3r.prior.config\n"
        "assert not {'torch', 'monai', 'lightning'} & set(sys.modules)\n"
        "import g3r.prior.model\n"
        "assert not {'lightning', 'pytorch_lightning', 'torchio'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
