"""Inputs of the prior: the base is the measured volume where slices covered, the template elsewhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inputs import PriorInputs

SHAPE = (1, 1, 8, 10, 12)
SMALL = PriorNetworkConfig(channels=(8, 8), units=(1, 1), tail_channels=4)
CONFIGS = {"coarse": SMALL, "sharp": replace(SMALL, sharp_base=True)}


@pytest.fixture
def given() -> PriorInputs:
    """Inputs in which the upper half is unseen and a part of the lower half is brain."""
    torch.manual_seed(0)
    coarse, sharp, template = (torch.rand(SHAPE) for _ in range(3))
    density, share, outline = torch.full(SHAPE, 3.0), torch.zeros(SHAPE), torch.zeros(SHAPE)
    density[..., 6:] = 0
    share[:, :, 2:6] = 1
    outline[:, :, :, 3:7] = 1
    return PriorInputs(coarse=coarse, density=density, share=share, sharp=sharp, template=template, outline=outline)


@pytest.mark.parametrize("name", CONFIGS)
def test_the_base_is_what_was_measured_and_the_template_where_nothing_was(given: PriorInputs, name: str) -> None:
    measured = getattr(given, name)
    assert given.template is not None
    base = given.base(CONFIGS[name])
    torch.testing.assert_close(base[..., 6:], given.template[..., 6:])
    torch.testing.assert_close(base[..., :6], measured[..., :6], atol=1e-5, rtol=0)
    # with higher density the measured volume dominates
    part = [
        float((replace(given, density=torch.full(SHAPE, m)).base(CONFIGS[name]) - measured).abs().mean())
        for m in (0.0, 0.2, 0.5, 1.0)
    ]
    assert part == sorted(part, reverse=True)
    assert part[2] < 0.2 * part[0]
    assert part[3] < 0.03 * part[0]
    assert torch.equal(given.base(replace(CONFIGS[name], use_template=False)), measured)


@pytest.mark.parametrize("name", CONFIGS)
def test_an_untrained_network_is_its_base(given: PriorInputs, name: str) -> None:
    with torch.no_grad():
        found = DensityGatedPriorNetwork(CONFIGS[name])(given)
    assert torch.equal(found.volume, given.base(CONFIGS[name]))
    brain = torch.sigmoid(found.brain_logit)
    assert given.share is not None
    assert given.outline is not None
    torch.testing.assert_close(brain[..., :6] > 0.5, given.share[..., :6] > 0.5)
    torch.testing.assert_close(brain[..., 6:] > 0.5, given.outline[..., 6:] > 0.5)
    assert float((brain - 0.5).abs().min()) > 0.449  # confident both ways, but not more than training can change
    assert float((brain - 0.5).abs().max()) < 0.499


def test_without_a_template_masks_say_what_is_brain(given: PriorInputs) -> None:
    network = DensityGatedPriorNetwork(replace(SMALL, use_template=False))
    assert given.share is not None
    assert torch.equal(network(given).brain_logit > 0, given.share > 0.5)
    assert bool((network(replace(given, share=None)).brain_logit > 0).all())


@pytest.mark.parametrize("density", [0.0, 0.3, 1.0, 30.0])
@pytest.mark.parametrize("alpha", [0.05, 0.5])
def test_the_network_changes_the_base_by_no_more_than_the_gate(
    given: PriorInputs, density: float, alpha: float
) -> None:
    """This holds however large its weights are."""
    torch.manual_seed(0)
    config = replace(SMALL, alpha=alpha)
    network = DensityGatedPriorNetwork(config)
    nn.init.normal_(network.refiner.head.weight, std=30.0)
    here = replace(given, density=torch.full(SHAPE, density))
    gate = float(network.gate(torch.tensor(density)))
    with torch.no_grad():
        change = (network(here).volume - here.base(config)).abs().max()
    assert 0.95 * gate < float(change) <= gate + 1e-6
    if density == 30:
        assert gate == pytest.approx(alpha)


def test_what_is_needed_is_asked_for(given: PriorInputs) -> None:
    network = DensityGatedPriorNetwork(SMALL)
    for missing, says in (("sharp", "needs V_sharp"), ("template", "fitted template"), ("outline", "fitted template")):
        with pytest.raises(ValueError, match=says):
            network(replace(given, **dict[str, Any]({missing: None})))
    plain = replace(SMALL, use_sharp=False, use_template=False)
    DensityGatedPriorNetwork(plain)(replace(given, sharp=None, template=None, outline=None, share=None))


def test_the_first_layer_sees_as_many_volumes_as_it_says(given: PriorInputs) -> None:
    for sharp in (False, True):
        for template in (False, True):
            for density in (False, True):
                config = replace(SMALL, use_sharp=sharp, use_template=template, use_density=density)
                assert len(given.shown(config)) == config.n_inputs


def test_mirroring_mirrors_every_volume(given: PriorInputs) -> None:
    turned = given.flip([2, 4])
    for name in ("coarse", "density", "share", "sharp", "template", "outline"):
        assert torch.equal(getattr(turned, name), getattr(given, name).flip([2, 4]))
    assert replace(given, share=None).flip([3]).share is None
