"""Every gradient of the renderer against float64 autograd of the dense reference."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from g3r.acquisition.planes import Planes
from g3r.gaussians import GaussianCloud, render
from tests.gradients import gradient_of

NAMES = ("mean_mm", "log_scale", "quaternion_wxyz", "amplitude", "twist", "log_gain")


def scene(seed: int, n: int = 6, n_planes: int = 3, psf: float = 1.0) -> tuple[list[Tensor], Planes, Tensor]:
    """Random Gaussians near the origin and random planes through it, as double leaves."""
    rng = np.random.default_rng(seed)
    leaves = [
        torch.tensor(rng.normal(0, 1.5, (n, 3))),
        torch.tensor(rng.normal(0.3, 0.3, (n, 3))),
        torch.tensor(rng.normal(size=(n, 4))),
        torch.tensor(rng.uniform(-0.5, 1, n)),
        torch.tensor(rng.normal(0, 0.2, (n_planes, 6))),
        torch.tensor(rng.normal(0, 0.2, n_planes)),
    ]
    planes = Planes(
        rotation=Rotation.random(n_planes, rng=seed).as_matrix(),
        center_mm=rng.normal(0, 0.5, (n_planes, 3)) + 50,
        spacing_mm=np.array([[0.8, 0.9]] * n_planes),
        shape=np.array([[30, 27]] * n_planes),
        psf_var_mm2=np.array([[0.2, 0.25, 1.2]] * n_planes) * psf,
    )
    pixel_weight = torch.tensor(rng.normal(size=planes.n_pixels))
    return leaves, planes, pixel_weight


def image(leaves: list[Tensor], planes: Planes, **options: Any) -> Tensor:
    cloud = GaussianCloud.of(leaves[:4], np.full(3, 50.0))
    return render(cloud, planes, twist=leaves[4], log_gain=leaves[5], **options)


def gradients(
    leaves: list[Tensor], planes: Planes, pixel_weight: Tensor, dtype: torch.dtype, **options: Any
) -> tuple[Tensor, list[Tensor]]:
    leaves = [leaf.detach().to(dtype).clone().requires_grad_() for leaf in leaves]
    pixels = image(leaves, planes, **options)
    (pixels * pixel_weight.to(pixels.dtype)).sum().backward()
    return pixels.detach(), [gradient_of(leaf) for leaf in leaves]


@pytest.mark.parametrize("attenuation", ["exact", "printed"])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("psf", [1.0, 0.0])
def test_numba_gradients_agree_with_float64_autograd(seed: int, attenuation: str, psf: float) -> None:
    leaves, planes, weight = scene(seed, psf=psf)
    expected, expected_grad = gradients(
        leaves, planes, weight, torch.float64, backend="reference", attenuation=attenuation
    )
    found, found_grad = gradients(leaves, planes, weight, torch.float32, cutoff_sigma=6.0, attenuation=attenuation)
    # the cut-off at 6 sigma leaves 1.5e-8 of an amplitude, the polynomial exponential 2e-7
    assert (found - expected).abs().max() < 3e-6 * expected.abs().max()
    for name, a, b in zip(NAMES, expected_grad, found_grad, strict=True):
        assert (a - b).norm() <= 1e-4 * a.norm(), name


@pytest.mark.parametrize("attenuation", ["exact", "printed"])
def test_reference_gradcheck(attenuation: str) -> None:
    leaves, planes, _ = scene(3, n=2, n_planes=2)
    planes = Planes(
        rotation=planes.rotation,
        center_mm=planes.center_mm,
        spacing_mm=planes.spacing_mm * 4,
        shape=np.array([[5, 4]] * 2),
        psf_var_mm2=planes.psf_var_mm2,
    )
    leaves = [leaf.requires_grad_() for leaf in leaves]
    assert torch.autograd.gradcheck(
        lambda *x: image(list(x), planes, backend="reference", attenuation=attenuation),
        leaves,
        rtol=1e-8,
        atol=1e-8,
        eps=1e-6,
    )


def test_gradient_of_twist_is_finite_at_zero_and_tiny_turns() -> None:
    leaves, planes, weight = scene(4)
    for size in (0.0, 1e-8):
        leaves[4] = torch.full_like(leaves[4], size)
        _, expected = gradients(leaves, planes, weight, torch.float64, backend="reference")
        _, found = gradients(leaves, planes, weight, torch.float32, cutoff_sigma=6.0)
        assert (expected[4] - found[4]).norm() <= 1e-4 * expected[4].norm()
