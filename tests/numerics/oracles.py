"""Oracles of the numerics suite, by integration and in float64, and naive formulas for comparison."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from g3r.acquisition.planes import Planes
from g3r.gaussians import GaussianCloud
from g3r.geometry.quaternion import rotation_from_quaternion

REACH = 6.5
"""Limit of integrals in sigmas; the rest beyond is 1e-10 of the whole."""

STEP = 0.5
"""Node spacing relative to the narrowest sigma of the integrand."""


def volume_at(cloud: GaussianCloud, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """V(x) of Eq. 3 at world points [P, 3]: rotated into a Gaussian's axes and divided by sigma, without an inverse."""
    mean, log_scale, quaternion, amplitude = (p.detach().double() for p in cloud.parameters)
    axes = rotation_from_quaternion(quaternion).numpy()
    total = np.zeros(len(points_mm))
    for j in range(len(cloud)):
        white = (points_mm - cloud.origin_mm - mean[j].numpy()) @ axes[j] / np.exp(log_scale[j].numpy())
        total += float(amplitude[j]) * np.exp(-0.5 * (white**2).sum(1))
    return total


def integrated_pixels(cloud: GaussianCloud, planes: Planes) -> NDArray[np.float64]:
    """Eq. 2 by quadrature: the integral of V times the PSF at every pixel, for Gaussians of any shape.

    The nodes lie along each Gaussian's own axes, where V is a product, with a spacing of half the integrand's narrowest
    sigma, from -6.5 to 6.5 sigma of the Gaussian or of the PSF, whichever ends first. Equidistant nodes
    converge exponentially for Gaussians: at half a sigma the error is 2 exp(-8 pi^2), beyond float64.
    No closed form of a product of Gaussians is used.

    Raises:
        ValueError: a plane without PSF, which needs no integration.
    """
    if len(planes) and not planes.psf_var_mm2.min() > 0:
        raise ValueError("a plane without PSF samples V(x); use volume_at")
    mean, log_scale, quaternion, amplitude = (p.detach().double() for p in cloud.parameters)
    axes, sigma = rotation_from_quaternion(quaternion).numpy(), log_scale.exp().numpy()
    world, plane_of = planes.pixel_world_mm(), planes.plane_id()
    pixels = np.zeros(planes.n_pixels)
    for p in range(planes.n_pixels):
        k = plane_of[p]
        variance = planes.psf_var_mm2[k]
        density = 1 / np.sqrt((2 * np.pi) ** 3 * variance.prod())
        for j in range(len(cloud)):
            frame = axes[j].T @ planes.rotation[k]  # the PSF's axes in those of the Gaussian
            at = (world[p] - cloud.origin_mm - mean[j].numpy()) @ axes[j]
            reach = REACH * np.sqrt((frame**2) @ variance)
            narrow = 1 / np.sqrt(1 / sigma[j] ** 2 + (frame**2) @ (1 / variance))
            low = np.maximum(-REACH * sigma[j], at - reach)
            high = np.minimum(REACH * sigma[j], at + reach)
            if (low >= high).any():
                continue
            nodes, step = [], 1.0
            for a in range(3):
                n = int(np.ceil((high[a] - low[a]) / (STEP * narrow[a]))) + 1
                nodes.append(np.linspace(low[a], high[a], n))
                step *= (high[a] - low[a]) / (n - 1)
            value = [np.exp(-0.5 * (nodes[a] / sigma[j, a]) ** 2) for a in range(3)]
            away = np.stack(np.meshgrid(*nodes, indexing="ij"), -1).reshape(-1, 3) - at
            psf = np.exp(-0.5 * ((away @ frame) ** 2 / variance).sum(1)) * density
            product = np.einsum("i,j,k->ijk", *value).ravel()
            pixels[p] += float(amplitude[j]) * step * float(product @ psf)
    return pixels


def naive_render(cloud: GaussianCloud, planes: Planes, dtype: torch.dtype, epsilon: float = 0.0) -> Tensor:
    """The formula as usually written: S as a product, inverse as adjugate over determinant, in one dtype.

    An epsilon (mm^6) is added to the determinant, as in some codes. It serves to show where this fails.
    """
    mean, log_scale, quaternion, amplitude = (p.detach().to(dtype) for p in cloud.parameters)
    root = rotation_from_quaternion(quaternion) * log_scale.exp()[:, None]
    sigma = root @ root.mT
    pixels = []
    for k in range(len(planes)):
        frame = torch.as_tensor(planes.rotation[k], dtype=dtype)
        s = frame.T @ sigma @ frame + torch.diag(torch.as_tensor(planes.psf_var_mm2[k], dtype=dtype))
        determinant = _determinant(s) + epsilon
        inverse = _adjugate(s) / determinant[:, None, None]
        factor = ((_determinant(sigma) + epsilon) / determinant).sqrt()
        center = torch.as_tensor(planes.center_mm[k] - cloud.origin_mm, dtype=dtype)
        uv = planes.pixel_uv_mm()[planes.offset[k] : planes.offset[k + 1]]
        u = torch.as_tensor(np.pad(uv, ((0, 0), (0, 1))), dtype=dtype)
        d = u[None] - ((mean - center) @ frame)[:, None]
        e = torch.einsum("npa,nab,npb->np", d, inverse, d)
        pixels.append((amplitude * factor) @ torch.exp(-0.5 * e))
    return torch.cat(pixels) if pixels else mean.new_zeros(0)


def absolute(cloud: GaussianCloud, dtype: torch.dtype) -> GaussianCloud:
    """The cloud with world coordinates in one dtype and without a local origin, as usual elsewhere."""
    mean = (cloud.mean_mm.double() + torch.from_numpy(cloud.origin_mm)).to(dtype)
    rest = [p.to(dtype) for p in cloud.parameters[1:]]
    return GaussianCloud.of([mean, rest[0], rest[1], rest[2]], np.zeros(3))


def naive_amplitudes(
    matrix: NDArray[np.float32], pixels: NDArray[np.float32], epsilon: float = 1e-8
) -> NDArray[np.float32]:
    """Amplitudes as weighted means of pixels, A^T y / (A^T 1 + epsilon): with an absolute epsilon."""
    return (matrix.T @ pixels) / (matrix.T @ np.ones_like(pixels) + np.float32(epsilon))


def _determinant(s: Tensor) -> Tensor:
    a, b, c, d, e, f = s[:, 0, 0], s[:, 0, 1], s[:, 0, 2], s[:, 1, 1], s[:, 1, 2], s[:, 2, 2]
    return a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)


def _adjugate(s: Tensor) -> Tensor:
    a, b, c, d, e, f = s[:, 0, 0], s[:, 0, 1], s[:, 0, 2], s[:, 1, 1], s[:, 1, 2], s[:, 2, 2]
    rows = [
        d * f - e * e,
        c * e - b * f,
        b * e - c * d,
        c * e - b * f,
        a * f - c * c,
        b * c - a * e,
        b * e - c * d,
        b * c - a * e,
        a * d - b * b,
    ]
    return torch.stack(rows, 1).reshape(-1, 3, 3)
