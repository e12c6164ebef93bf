"""Both renderers against an independent 3D quadrature of G3R Eq. 2, with and without PSF."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, volume_planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.gaussians import GaussianCloud, render
from g3r.geometry import VolumeGrid
from tests.gaussians.scenes import assert_same_images, cloud_of, make_cloud, make_planes, single


def volume_at(cloud: GaussianCloud, points_mm: np.ndarray) -> np.ndarray:
    """V(x) of Eq. 3 at points [P, 3]."""
    mean, log_scale, wxyz, amplitude = (p.double().numpy() for p in cloud.parameters)
    total = np.zeros(len(points_mm))
    for j in range(len(mean)):
        axes = Rotation.from_quat(np.roll(wxyz[j], -1)).as_matrix()
        white = (points_mm - cloud.origin_mm - mean[j]) @ axes / np.exp(log_scale[j])
        total += amplitude[j] * np.exp(-0.5 * (white**2).sum(1))
    return total


def quadrature(cloud: GaussianCloud, planes: Planes) -> np.ndarray:
    """Eq. 2: each pixel as the integral of PSF times V on a dense product grid out to 6.5 sigma.

    Equidistant nodes converge exponentially for products of Gaussians. With a node spacing of half the narrowest sigma
    of the product the error is exp(-2 pi^2 4), beyond double precision; the tails hold 1e-10.
    """
    sigma_cloud = float(cloud.log_scale.exp().min())
    pixels = []
    for k in range(len(planes)):
        axes = []
        for variance in planes.psf_var_mm2[k]:
            sigma = np.sqrt(variance)
            step = 0.5 / np.hypot(1 / sigma, 1 / sigma_cloud)
            nodes = np.arange(-np.ceil(6.5 * sigma / step), np.ceil(6.5 * sigma / step) + 1) * step
            weight = np.exp(-0.5 * nodes**2 / variance) * step / np.sqrt(2 * np.pi * variance)
            axes.append((nodes, weight))
        nodes = np.stack(np.meshgrid(*[a[0] for a in axes], indexing="ij"), -1).reshape(-1, 3)
        weight = np.einsum("i,j,k->ijk", *[a[1] for a in axes]).ravel()
        n_x, n_y = planes.shape[k]
        for i in range(n_x):
            for j in range(n_y):
                u = [(i - (n_x - 1) / 2) * planes.spacing_mm[k, 0], (j - (n_y - 1) / 2) * planes.spacing_mm[k, 1], 0.0]
                points = (nodes + u) @ planes.rotation[k].T + planes.center_mm[k]
                pixels.append(weight @ volume_at(cloud, points))
    return np.array(pixels)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_backends_agree_with_quadrature(seed: int) -> None:
    cloud, planes = make_cloud(seed, 4), make_planes(seed + 10, n=2, shape=(4, 3))
    expected = quadrature(cloud, planes)
    scale = np.abs(expected).max()
    reference = render(cloud, planes, backend="reference").numpy()
    assert np.abs(reference - expected).max() < 1e-6 * scale
    found = render(single(cloud), planes, cutoff_sigma=6.0).numpy()
    # float32 parameters and sums, polynomial exponential 2e-7, cut-off exp(-18) = 1.5e-8 per Gaussian
    assert np.abs(found - expected).max() < 3e-6 * scale
    default = render(single(cloud), planes).numpy()
    assert np.abs(default - expected).max() < 0.006 * float(cloud.amplitude.abs().sum())


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_the_printed_attenuation_is_off_by_the_factor_of_the_design(backend: str) -> None:
    """The factor is 0.53 at sigma 1 mm, 0.8 mm pixels, 3 mm slices; quadrature agrees with the exact form."""
    one = cloud_of(np.zeros((1, 3)), np.zeros((1, 3)), [[1.0, 0, 0, 0]], [1.0])
    planes = Planes(
        rotation=np.eye(3)[None],
        center_mm=np.zeros((1, 3)),
        spacing_mm=np.array([[0.8, 0.8]]),
        shape=np.array([[1, 1]]),
        psf_var_mm2=psf_variance_mm2([[0.8, 0.8]], np.array([3.0])),
    )
    exact = render(one, planes, backend=backend).item()
    printed = render(one, planes, backend=backend, attenuation="printed").item()
    assert exact / printed == pytest.approx(0.5295, abs=2e-4)
    assert quadrature(one, planes)[0] == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_without_psf_a_plane_samples_the_volume(backend: str) -> None:
    cloud, planes = make_cloud(3, 8), make_planes(3, psf=0.0, shape=(20, 15))
    expected = volume_at(cloud, planes.pixel_world_mm())
    if backend == "reference":
        np.testing.assert_allclose(render(cloud, planes, backend=backend), expected, rtol=0, atol=1e-12)
    else:
        found = render(single(cloud), planes, cutoff_sigma=6.0).numpy()
        assert np.abs(found - expected).max() < 3e-6 * np.abs(expected).max()


def test_a_volume_is_its_planes() -> None:
    cloud = make_cloud(4, 8)
    affine = np.diag([-1.0, 1.2, 0.9, 1])
    affine[:3, 3] = cloud.origin_mm + np.array([4, -5, -4])
    grid = VolumeGrid((9, 8, 7), affine)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    expected = volume_at(cloud, grid.world(index).transpose(2, 0, 1, 3).reshape(-1, 3))
    np.testing.assert_allclose(render(cloud, volume_planes(grid), backend="reference"), expected, atol=1e-12)


def test_one_gaussian_and_one_pixel() -> None:
    cloud, planes = make_cloud(14, 1), make_planes(14, n=1, shape=(1, 1))
    assert_same_images((cloud, planes), (cloud, planes))
    assert render(cloud, planes, backend="reference").item() == pytest.approx(quadrature(cloud, planes)[0], rel=1e-8)
