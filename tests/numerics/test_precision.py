"""Mixed precision only in the networks: geometry, poses and images are never computed under autocast."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from g3r.gaussians import GaussianCloud, render
from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.geometry import moved_points, nearest_rotation, rotation_from_vector
from g3r.pose_network.network import PoseNetwork
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.inputs import PriorInputs
from tests.gradients import gradient_of
from tests.numerics.scenes import head_scene, single
from tests.tally import Tally


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_the_renderer_does_not_notice_autocast(backend: str, dtype: torch.dtype, tally: Tally) -> None:
    scene = head_scene()

    def pixels_and_gradients(mixed: bool) -> list[torch.Tensor]:
        leaves = [p.clone().requires_grad_() for p in single(scene.cloud).parameters]
        twist = torch.full((len(scene.planes), 6), 1e-2, requires_grad=True)
        cloud = GaussianCloud.of(leaves, scene.cloud.origin_mm)
        with torch.autocast("cpu", dtype, enabled=mixed):  # backward passes belong outside of it
            pixels = render(cloud, scene.planes, twist=twist, backend=backend)
        pixels.square().sum().backward()
        return [pixels.detach(), *(gradient_of(leaf) for leaf in (*leaves, twist))]

    plain = pixels_and_gradients(False)
    with tally.case():
        for a, b in zip(plain, pixels_and_gradients(True), strict=True):
            assert b.dtype == torch.float32
            assert torch.equal(a, b)


def test_a_renderer_under_autocast_would_be_wrong() -> None:
    """The naive formula fails under the same autocast, which is why the reference switches it off."""
    from tests.numerics.oracles import naive_render

    scene = head_scene()
    exact = render(scene.cloud, scene.planes, backend="reference")
    with torch.autocast("cpu", torch.bfloat16):
        found = naive_render(scene.cloud, scene.planes, torch.float32)
    assert not (found - exact).abs().max() < 1e-3 * exact.max()


def test_poses_under_autocast_are_those_without(tally: Tally) -> None:
    torch.manual_seed(0)
    network = PoseNetwork(PoseNetworkConfig(channels=(4, 8, 8), width=16, n_blocks=1, n_heads=2)).eval()
    network.set_template(torch.rand(2, 6, 6, 6))
    n = 6
    batch = {
        "image": torch.rand(n, 1, 40, 40),
        "stack": torch.tensor([0, 0, 1, 1, 2, 2]),
        "set_of_stack": torch.tensor([0, 0, 0]),
        "header_rotation": torch.eye(3).expand(n, 3, 3),
        "position_mm": torch.arange(n) * 2.0,
        "thickness_mm": torch.full((n,), 2.0),
        "area_mm2": torch.full((n,), 900.0),
        "time_rank": torch.linspace(0, 1, n),
    }
    with torch.no_grad():
        plain = network(batch)
        with tally.case():
            with torch.autocast("cpu", torch.bfloat16):
                mixed = network(batch)
            for a, b in zip(plain, mixed, strict=True):
                for one, other in zip(a, b, strict=True):
                    assert other.dtype == torch.float32
                    assert torch.equal(one, other)


def test_points_and_rotations_of_training_keep_float32(tally: Tally) -> None:
    rng = torch.Generator().manual_seed(0)
    matrix, points = torch.randn(5, 3, 3, generator=rng), 25 * torch.randn(4, 3, generator=rng)
    rotation, shift = nearest_rotation(matrix), torch.randn(5, 3, generator=rng)
    with tally.case(), torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(moved_points(rotation, shift, points), moved_points_plainly(rotation, shift, points))
        again = nearest_rotation(matrix)
        assert again.dtype == torch.float32
        assert (again - rotation).abs().max() < 1e-6
        turned = rotation_from_vector(torch.full((2, 3), 0.1))
        assert turned.dtype == torch.float32


def moved_points_plainly(rotation: torch.Tensor, shift: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    with torch.autocast("cpu", enabled=False):
        return points @ rotation.transpose(1, 2) + shift[:, None]


@pytest.mark.parametrize("density", [0.0, 1.0, 1e6])
def test_the_prior_network_may_run_in_bfloat16_and_its_volume_stays_float32(density: float, tally: Tally) -> None:
    """Rounding affects only the residual, of which the gate passes a twentieth where slices are dense."""
    torch.manual_seed(0)
    config = PriorNetworkConfig(channels=(4, 8), units=(1, 1), tail_channels=2, use_sharp=False, use_template=False)
    network = DensityGatedPriorNetwork(config).eval()
    torch.nn.init.normal_(network.refiner.head.weight, std=0.1)
    coarse = torch.rand(1, 1, 16, 16, 16)
    m = torch.full_like(coarse, density)
    with torch.no_grad(), tally.case():
        given = PriorInputs(coarse=coarse, density=m)
        plain = network(given).volume
        with torch.autocast("cpu", torch.bfloat16):
            mixed = network(given).volume
        assert mixed.dtype == torch.float32
        residual = network.refiner(given)[0].abs().max()
        gate = float(network.gate(torch.tensor(density)))
        assert (mixed - plain).abs().max() <= 0.05 * gate * residual
        assert np.isfinite(mixed.numpy()).all()
