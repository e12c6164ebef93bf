"""Memory savings of the prior network: layers in slabs, tiles of one shape."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.inference import _tiles
from g3r.prior.inputs import PriorInputs
from g3r.prior.network import SLAB_ROWS, ResidualRefiner


def noise(*shape: int) -> PriorInputs:
    v_coarse, m_rho = torch.rand(2, 1, 1, *shape)
    return PriorInputs(coarse=v_coarse, density=m_rho)


@pytest.fixture(scope="module")
def refiner() -> ResidualRefiner:
    torch.manual_seed(0)
    config = PriorNetworkConfig(channels=(8, 16), units=(1, 1), tail_channels=4, use_sharp=False, use_template=False)
    refiner = ResidualRefiner(config).eval()
    nn.init.normal_(refiner.head.weight, std=0.1)
    return refiner


@pytest.mark.parametrize("extra", [-1, 2, 3, SLAB_ROWS, SLAB_ROWS + 5, 2 * SLAB_ROWS + 1])
def test_slabs_give_what_the_whole_gives(refiner: ResidualRefiner, extra: int) -> None:
    rows = 2 * (SLAB_ROWS + extra)
    given = noise(rows, 12, 20)
    whole = refiner(given)  # with gradients the layer runs in one piece
    with torch.inference_mode():
        slabs = refiner(given)
    for one, two in zip(slabs, whole, strict=True):
        assert two.requires_grad
        assert one.shape == given.coarse.shape
        assert two.std() > 0.01
        assert (one - two).abs().max() < 1e-5


def test_slabs_all_have_one_shape(refiner: ResidualRefiner, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = set()
    layers = refiner._at_full_resolution

    def watched(features: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        seen.add((features.shape, inputs.shape))
        return layers(features, inputs)

    monkeypatch.setattr(refiner, "_at_full_resolution", watched)
    with torch.inference_mode():
        refiner(noise(2 * (3 * SLAB_ROWS + 7), 8, 8))
    ((features, _),) = seen
    assert features[2] == SLAB_ROWS + 2


def test_gradients_are_those_of_a_network_that_keeps_everything(refiner: ResidualRefiner) -> None:
    """Activations overwrite their input, which is not needed afterwards."""
    other = copy.deepcopy(refiner)
    for module in other.modules():
        if isinstance(module, nn.LeakyReLU):
            assert module.inplace
            module.inplace = False
    given = noise(12, 8, 8)
    found, expected = (
        torch.autograd.grad(torch.cat(network(given)).square().sum(), list(network.parameters()))
        for network in (refiner, other)
    )
    for one, two in zip(found, expected, strict=True):
        torch.testing.assert_close(one, two)


@pytest.mark.parametrize(
    ("shape", "edge", "halo"),
    [((50, 64, 40), 16, 8), ((50, 64, 40), 16, 0), ((37, 20, 90), 24, 8), ((16, 16, 16), 16, 8), ((9, 9, 9), 4, 40)],
)
def test_tiles_have_one_shape_and_cover_everything_once(shape: tuple[int, ...], edge: int, halo: int) -> None:
    covered = torch.zeros(shape, dtype=torch.int64)
    shapes = set()
    for core, seen in _tiles(shape, edge, halo):
        covered[core] += 1
        shapes.add(tuple(one.stop - one.start for one in seen))
        for wanted, given, extent in zip(core, seen, shape, strict=True):
            assert 0 <= given.start <= max(wanted.start - halo, 0)
            assert min(wanted.stop + halo, extent) <= given.stop <= extent
    assert (covered == 1).all()
    assert len(shapes) == 1
