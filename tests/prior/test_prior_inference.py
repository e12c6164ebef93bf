from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from g3r.errors import NumericalError
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inference import estimate_prior
from g3r.prior.inputs import PriorInputs
from g3r.prior.maps import EstimatedPrior, PriorMaps, Tiling
from tests.prior.receptive_field import receptive_radius_voxels


def small(n_levels: int = 1, **changes: Any) -> DensityGatedPriorNetwork:
    """A network of 8 channels that sees V_coarse and M."""
    levels: dict[str, Any] = {"channels": (8,) * n_levels, "units": (1,) * n_levels, "tail_channels": 4}
    return DensityGatedPriorNetwork(
        PriorNetworkConfig(**levels, **{"use_sharp": False, "use_template": False, **changes})
    ).eval()


@pytest.fixture(scope="module")
def network() -> DensityGatedPriorNetwork:
    """The default network with a last layer that gives a residual of a tenth of the intensity scale."""
    torch.manual_seed(0)
    network = DensityGatedPriorNetwork(PriorNetworkConfig(use_sharp=False, use_template=False)).eval()
    nn.init.normal_(network.refiner.head.weight, std=0.008)
    return network


@pytest.fixture(scope="module")
def maps() -> PriorMaps:
    rng = np.random.default_rng(0)
    v_coarse = rng.random((250, 20, 17), dtype=np.float32)
    return PriorMaps(coarse=v_coarse, density=3 * rng.random(v_coarse.shape, dtype=np.float32))


def part_of(maps: PriorMaps, *box: slice) -> PriorMaps:
    return PriorMaps(coarse=maps.coarse[box], density=maps.density[box])


def largest_difference(one: EstimatedPrior, other: EstimatedPrior) -> float:
    return float(max(np.abs(one.volume - other.volume).max(), np.abs(one.brain - other.brain).max()))


@pytest.fixture(scope="module")
def whole(network: DensityGatedPriorNetwork, maps: PriorMaps) -> EstimatedPrior:
    return estimate_prior(network, maps)


def test_whole_volume_is_the_network_s_output(
    network: DensityGatedPriorNetwork, maps: PriorMaps, whole: EstimatedPrior
) -> None:
    v_coarse, m_rho = (torch.from_numpy(volume)[None, None] for volume in (maps.coarse, maps.density))
    with torch.no_grad():
        expected = network(PriorInputs(coarse=v_coarse, density=m_rho))
    assert whole.volume.dtype == whole.brain.dtype == np.float32
    np.testing.assert_allclose(whole.volume, expected.volume[0, 0].numpy(), rtol=0, atol=1e-6)
    np.testing.assert_allclose(whole.brain, expected.brain_logit.sigmoid()[0, 0].numpy(), rtol=0, atol=1e-6)
    assert 0.03 < np.std(whole.volume - maps.coarse) < 0.3


def test_tiles_agree_with_the_whole(network: DensityGatedPriorNetwork, maps: PriorMaps, whole: EstimatedPrior) -> None:
    tiled = estimate_prior(network, maps, tiling=Tiling(max_whole_voxels=0, tile_voxels=48))
    # The default halo, with white noise and random weights, which have longer reach than images and trained weights.
    assert largest_difference(tiled, whole) < 1e-3


def test_tiles_are_exact_beyond_the_receptive_field(
    network: DensityGatedPriorNetwork, maps: PriorMaps, whole: EstimatedPrior
) -> None:
    halo = receptive_radius_voxels(network.config)
    tiled = estimate_prior(network, maps, tiling=Tiling(0, tile_voxels=40, halo_voxels=halo))
    # Rounding only: with other extents the convolution sums in another order.
    assert largest_difference(tiled, whole) < 1e-5


def test_views_do_not_prefer_a_side(maps: PriorMaps) -> None:
    """The mean over all mirror images of a mirrored head is the mirrored mean, in tiles or whole."""
    torch.manual_seed(0)
    network = small(n_levels=2)
    nn.init.normal_(network.refiner.head.weight, std=0.05)
    part = part_of(maps, slice(50))
    prior = estimate_prior(network, part, n_views=8)
    assert largest_difference(prior, estimate_prior(network, part)) > 1e-3
    tiled = estimate_prior(network, part, n_views=8, tiling=Tiling(0, tile_voxels=20, halo_voxels=32))
    assert largest_difference(tiled, prior) < 1e-5
    even = part_of(maps, slice(48), slice(16), slice(16))  # an odd size is padded at one end only
    turned = part_of(even, slice(None, None, -1), slice(None), slice(None, None, -1))
    straight, back = (estimate_prior(network, given, n_views=8) for given in (even, turned))
    np.testing.assert_allclose(back.volume[::-1, :, ::-1], straight.volume, atol=1e-5)
    np.testing.assert_allclose(back.brain[::-1, :, ::-1], straight.brain, atol=1e-5)
    with pytest.raises(ValueError, match="expected 1 to 8"):
        estimate_prior(network, part, n_views=9)


def test_v_sharp_is_asked_for_and_is_the_base(maps: PriorMaps) -> None:
    network = small(use_sharp=True, sharp_base=True)
    v_sharp = maps.coarse[::-1].copy()
    np.testing.assert_array_equal(estimate_prior(network, replace(maps, sharp=v_sharp)).volume, v_sharp)
    with pytest.raises(ValueError, match="needs V_sharp"):
        estimate_prior(network, maps)


def test_without_a_halo_they_do_not_agree(
    network: DensityGatedPriorNetwork, maps: PriorMaps, whole: EstimatedPrior
) -> None:
    """This shows that the two tests above would detect cut-off tiles."""
    tiled = estimate_prior(network, maps, tiling=Tiling(0, tile_voxels=48, halo_voxels=0))
    assert largest_difference(tiled, whole) > 1e-2


def test_odd_tile_sizes_cover_every_voxel() -> None:
    network = small()
    v_coarse = np.random.default_rng(0).random((13, 7, 22), dtype=np.float32)
    maps = PriorMaps(coarse=v_coarse, density=0 * v_coarse)
    prior = estimate_prior(network, maps, tiling=Tiling(0, tile_voxels=5, halo_voxels=3))
    np.testing.assert_array_equal(prior.volume, v_coarse)


def test_inputs_in_other_layouts_and_types(network: DensityGatedPriorNetwork) -> None:
    v_coarse = np.random.default_rng(0).random((9, 10, 11))
    straight = PriorMaps(coarse=v_coarse.astype(np.float32), density=np.ones((9, 10, 11), np.float32))
    turned = PriorMaps(coarse=np.asfortranarray(v_coarse), density=np.ones((9, 10, 11)))  # type: ignore[arg-type]
    assert largest_difference(estimate_prior(network, straight), estimate_prior(network, turned)) == 0


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 5), (4, 4, 0)])
def test_shapes_that_do_not_fit(shape: tuple[int, int] | tuple[int, int, int]) -> None:
    right, wrong = np.zeros((4, 4, 4), np.float32), np.zeros(shape, np.float32)
    for given in ({"density": wrong}, {"density": right, "template": wrong}):
        with pytest.raises(ValueError, match="3D volumes of one shape"):
            PriorMaps(coarse=right, **given)


def test_nan_is_reported(network: DensityGatedPriorNetwork) -> None:
    v_coarse = np.full((8, 8, 8), np.nan, np.float32)
    with pytest.raises(NumericalError, match="NaN"):
        estimate_prior(network, PriorMaps(coarse=v_coarse, density=np.ones_like(v_coarse)))


@pytest.mark.parametrize("wrong", [{"tile_voxels": 0}, {"halo_voxels": -1}])
def test_tiles_without_meaning_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="a tile needs voxels"):
        Tiling(**wrong)
