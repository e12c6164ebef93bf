"""Amplitudes by conjugate gradients: adjoint of the system, exact recovery, and unseen Gaussians."""

import numpy as np
import pytest
import torch

from g3r.acquisition.planes import Planes
from g3r.gaussians import GaussianCloud, render, solve_amplitudes
from g3r.gaussians.amplitudes import AmplitudeSystem
from tests.gaussians.scenes import cloud_of, stack_planes


def scene(seed: int = 0) -> tuple[GaussianCloud, Planes]:
    """A jittered lattice of 64 Gaussians 3 mm apart, and three stacks of planes through it."""
    rng = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(*[np.arange(4) * 3.0 - 4.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    n = len(lattice)
    cloud = cloud_of(
        lattice + rng.normal(0, 0.3, (n, 3)),
        np.log(rng.uniform(1.0, 1.8, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.uniform(0.2, 1.0, n),
        (10.0, 20, 30),
    )
    return cloud, stack_planes(7, 2.2, 18, cloud.origin_mm)


def test_the_adjoint_of_the_system() -> None:
    cloud, planes = scene()
    rng = np.random.default_rng(1)
    system = AmplitudeSystem(cloud, planes, gain=rng.uniform(0.5, 2, len(planes)))
    amplitude, pixels = (rng.normal(size=n).astype(np.float32) for n in (len(cloud), planes.n_pixels))
    image, back = system.forward(amplitude).astype(np.float64), system.adjoint(pixels)
    # both the system and its adjoint sum in float32
    assert abs(image @ pixels - amplitude @ back) < 1e-5 * np.linalg.norm(image) * np.linalg.norm(pixels)


def test_the_system_is_the_renderer() -> None:
    cloud, planes = scene()
    gain = np.linspace(0.5, 2, len(planes))
    expected = render(cloud, planes, log_gain=torch.tensor(np.log(gain)))
    found = AmplitudeSystem(cloud, planes, gain=gain).forward(cloud.amplitude.numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_projections_that_may_not_be_held_are_made_again() -> None:
    cloud, planes = scene()
    whole = AmplitudeSystem(cloud, planes)
    parted = AmplitudeSystem(cloud, planes, projection_bytes=5000)
    assert len(whole.parts) == 1
    assert len(parted.parts) > 3
    assert parted.parts[0][0] == 0
    assert parted.parts[-1][1] == len(planes)
    amplitude, pixels = cloud.amplitude.numpy(), np.ones(planes.n_pixels, np.float32)
    for _ in range(2):
        np.testing.assert_array_equal(parted.forward(amplitude), whole.forward(amplitude))
        np.testing.assert_allclose(parted.adjoint(pixels), whole.adjoint(pixels), rtol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 1e-6])
def test_known_amplitudes_are_recovered(damping: float) -> None:
    cloud, planes = scene()
    gain = np.linspace(0.5, 2, len(planes))
    target = AmplitudeSystem(cloud, planes, gain=gain).forward(cloud.amplitude.numpy())
    start = cloud.with_amplitude(torch.zeros(len(cloud)))
    found = solve_amplitudes(
        start, planes, target, np.ones(planes.n_pixels, np.float32), gain=gain, n_iterations=60, damping=damping
    )
    assert (found.amplitude - cloud.amplitude).abs().max() < 2e-3
    assert torch.equal(found.mean_mm, cloud.mean_mm)


def test_more_iterations_never_fit_worse() -> None:
    cloud, planes = scene()
    rng = np.random.default_rng(2)
    target = (render(cloud, planes).numpy() + rng.normal(0, 0.1, planes.n_pixels)).astype(np.float32)
    start, weight = cloud.with_amplitude(torch.zeros(len(cloud))), np.ones(planes.n_pixels, np.float32)
    errors = [
        float(
            (
                (render(solve_amplitudes(start, planes, target, weight, n_iterations=n), planes).numpy() - target) ** 2
            ).sum()
        )
        for n in (0, 1, 2, 4, 8, 16)
    ]
    assert (np.diff(errors) <= 1e-4 * errors[0]).all()
    assert errors[-1] < 0.1 * errors[0]


def test_pixels_of_weight_zero_do_not_count() -> None:
    cloud, planes = scene()
    target = render(cloud, planes).numpy()
    weight = np.ones(planes.n_pixels, np.float32)
    weight[::3] = 0
    target[::3] = 1e3
    start = cloud.with_amplitude(torch.zeros(len(cloud)))
    found = solve_amplitudes(start, planes, target, weight, n_iterations=80, damping=1e-6)
    assert (found.amplitude - cloud.amplitude).abs().max() < 5e-3


def test_what_no_pixel_sees_stays() -> None:
    cloud, planes = scene()
    away = Planes(
        rotation=planes.rotation,
        center_mm=planes.center_mm + 500,
        spacing_mm=planes.spacing_mm,
        shape=planes.shape,
        psf_var_mm2=planes.psf_var_mm2,
    )
    ones = np.ones(planes.n_pixels, np.float32)
    assert torch.equal(solve_amplitudes(cloud, away, ones, ones).amplitude, cloud.amplitude)
    assert torch.equal(solve_amplitudes(cloud, planes, ones, 0 * ones).amplitude, cloud.amplitude)
    # one unseen Gaussian among seen ones
    mean = cloud.mean_mm.clone()
    mean[5] += 300
    lost = GaussianCloud.of((mean, *cloud.parameters[1:]), cloud.origin_mm)
    found = solve_amplitudes(lost, planes, ones, ones)
    assert found.amplitude[5] == cloud.amplitude[5]
    assert not torch.equal(found.amplitude, cloud.amplitude)


def test_no_gaussian_at_all() -> None:
    cloud, planes = scene()
    ones = np.ones(planes.n_pixels, np.float32)
    assert len(solve_amplitudes(cloud.take(torch.zeros(0, dtype=torch.long)), planes, ones, ones)) == 0


def test_strong_damping_holds_the_amplitudes() -> None:
    cloud, planes = scene()
    ones = np.ones(planes.n_pixels, np.float32)
    change = [
        float((solve_amplitudes(cloud, planes, ones, ones, damping=d).amplitude - cloud.amplitude).norm())
        for d in (1e-3, 1.0, 1e3)
    ]
    assert change[0] > change[1] > change[2]
    assert change[2] < 0.01 * change[0]
