"""The plain torch renderer: every Gaussian on every pixel, any dtype and device. The oracle of the tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from g3r.acquisition.planes import Planes
from g3r.gaussians.cloud import GaussianCloud
from g3r.geometry.quaternion import rotation_from_quaternion
from g3r.run.on_demand import torch

if TYPE_CHECKING:
    from torch import Tensor

PAIRS_AT_ONCE = 4_000_000


def render_reference(
    cloud: GaussianCloud,
    planes: Planes,
    twist: Tensor | None = None,
    log_gain: Tensor | None = None,
    attenuation: str = "exact",
) -> Tensor:
    """Dense y(u) = sum_j c_j B_j exp(-d^T S_j^-1 d / 2) without cut-off (G3R Eq. 3-5); see `render`.

    Works in the dtype (float64 or float32) and on the device of the cloud, whatever autocast is around it;
    poses are float64 in any case. Differentiable by autograd in everything.

    Args:
        cloud: N Gaussians.
        planes: K planes.
        twist: [K, 6] as in `render`.
        log_gain: [K] as in `render`.
        attenuation: "exact" or "printed", as in `render`.

    Numerics: the triangular factor of S = M M^T, M = [R^T R_g diag(s), D^(1/2)], comes from M itself by QR. A
    Cholesky factor of S would lose twice the digits and fail in float32 at axis ratios of a few thousand.
    """
    with torch.autocast(cloud.mean_mm.device.type, enabled=False):
        return _render(cloud, planes, twist, log_gain, attenuation)


def _render(
    cloud: GaussianCloud, planes: Planes, twist: Tensor | None, log_gain: Tensor | None, attenuation: str
) -> Tensor:
    mean, log_scale, quaternion, amplitude = cloud.parameters
    like: dict[str, Any] = {"dtype": mean.dtype, "device": mean.device}
    exact: dict[str, Any] = {"dtype": torch.float64, "device": mean.device}
    root = rotation_from_quaternion(quaternion) * log_scale.exp()[:, None, :]
    pixels = []
    uv = planes.pixel_uv_mm()
    for k in range(len(planes)):
        rotation = torch.as_tensor(planes.rotation[k], **exact)
        center = torch.as_tensor(planes.center_mm[k] - cloud.origin_mm, **exact)
        if twist is not None:
            rotation = rotation @ torch.linalg.matrix_exp(_skew(twist[k, :3].to(**exact)))
            center = center + twist[k, 3:].to(**exact)
        local_mean = ((mean.to(**exact) - center) @ rotation).to(**like)
        rotation = rotation.to(**like)
        psf_sigma = torch.as_tensor(np.sqrt(planes.psf_var_mm2[k]), **like)
        # S = R^T Sigma R + D_psf (Eq. 4) as M M^T
        wide = torch.cat([rotation.T @ root, torch.diag(psf_sigma).expand(len(mean), 3, 3)], 2)
        upper = torch.linalg.qr(wide.transpose(1, 2))[1]
        if attenuation == "exact":
            factor = (log_scale.sum(1) - upper.diagonal(dim1=1, dim2=2).abs().log().sum(1)).exp()
        else:
            factor = torch.ones_like(amplitude)
        gain = 1.0 if log_gain is None else log_gain[k].to(**like).exp()
        block = uv[planes.offset[k] : planes.offset[k + 1]]
        step = max(1, PAIRS_AT_ONCE // max(1, len(mean)))
        for start in range(0, len(block), step):
            u = torch.as_tensor(np.pad(block[start : start + step], ((0, 0), (0, 1))), **like)
            d = u[None] - local_mean[:, None]  # [N, p, 3]
            white = torch.linalg.solve_triangular(upper.mT, d.transpose(1, 2), upper=False)
            value = torch.exp(-0.5 * (white * white).sum(1))
            # Eq. 5
            pixels.append(gain * ((amplitude * factor) @ value))
    return torch.cat(pixels) if pixels else mean.new_zeros(0)


def _skew(w: Tensor) -> Tensor:
    zero = torch.zeros_like(w[0])
    return torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
