"""render(cloud, planes): the one renderer, for prior fitting, slice fitting, writing and simulating."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes
from g3r.gaussians import kernels
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.overlap import OverlapList, find_overlaps
from g3r.gaussians.reference import render_reference
from g3r.geometry import RigidPose
from g3r.run.on_demand import torch

if TYPE_CHECKING:
    from torch import Tensor

CUTOFF_SIGMA = 3.2
"""Gaussians end here by default; at 3.2 sigma a Gaussian has fallen to 0.6 % of its amplitude."""

MAX_CUTOFF_SIGMA = 6.0
"""Largest cut-off: the polynomial exponential is accurate to here (e = -18)."""

ATTENUATIONS = ("exact", "printed")


def render(
    cloud: GaussianCloud,
    planes: Planes,
    *,
    twist: Tensor | None = None,
    log_gain: Tensor | None = None,
    backend: str = "numba",
    attenuation: str = "exact",
    cutoff_sigma: float = CUTOFF_SIGMA,
    overlaps: OverlapList | None = None,
) -> Tensor:
    """Pixels of planes through their PSF, differentiable in cloud, poses and gains.

    y(u) = g sum_j c_j B_j exp(-d^T S_j^-1 d / 2), d = u - R^T (mu_j - t), S = R^T Sigma R + D_psf,
    B = sqrt(|Sigma| / |S|) (G3R Eq. 4 and 5). A plane whose PSF is zero samples the volume V(x) (G3R Eq. 3).

    Args:
        cloud: N Gaussians.
        planes: K planes.
        twist: [K, 6] change of the poses: R <- R exp(w) (rad, body frame), t <- t + v (mm, world).
        log_gain: [K] logarithm of the intensity factor of each plane.
        backend: "numba" (CPU, gradients by moments), or "reference" (plain torch, dense, any dtype, no
            cut-off).
        attenuation: "exact", or "printed" for B = 1 as in the printed G3R Eq. 5 (for comparison).
        cutoff_sigma: where a Gaussian ends, up to 6 (numba only).
        overlaps: list from `find_overlaps`, to be used again while nothing moves far (numba only).

    Returns:
        [P] pixels, plane after plane, in C order inside a plane.

    Raises:
        ValueError: an unknown backend or attenuation, parameters in half precision, a cut-off outside (0, 6], a
            twist or gain that is not finite, or a sigma of more than 1e8 pixels (numba only).

    Source: G3R Eq. 3-5 with the attenuation B (docs/method.md, "Gaussians"). The backward pass is
        `kernels_backward.backward`.
    """
    if attenuation not in ATTENUATIONS:
        raise ValueError(f"attenuation {attenuation!r}; expected one of {ATTENUATIONS}")
    if cloud.mean_mm.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"Gaussians in {cloud.mean_mm.dtype}; expected float32 or float64: no geometry in less")
    for name, change in (("twist", twist), ("log_gain", log_gain)):
        if change is not None and not bool(torch.isfinite(change.detach()).all()):
            raise ValueError(f"{name} holds values that are not finite")
    if backend == "reference":
        return render_reference(cloud, planes, twist, log_gain, attenuation)
    if backend != "numba":
        raise ValueError(f"backend {backend!r}; expected 'numba' or 'reference'")
    if not 0 < cutoff_sigma <= MAX_CUTOFF_SIGMA:
        raise ValueError(f"cutoff_sigma {cutoff_sigma}; expected above 0 and at most {MAX_CUTOFF_SIGMA}")
    if len(cloud) and len(planes):
        widest = float(cloud.log_scale.detach().max().double().exp() / planes.spacing_mm.min())
        if widest > kernels.MAX_PIXELS / 10:
            raise ValueError(f"a sigma is {widest:.2g} pixels wide; expected at most {kernels.MAX_PIXELS / 10:g}")
    if overlaps is None:
        overlaps = find_overlaps(cloud, moved_planes(planes, twist), cutoff_sigma)
    exact = attenuation == "exact"
    from g3r.gaussians.render_function import RenderFunction  # imports torch, since it derives from one of its classes

    pixels: Tensor = RenderFunction.apply(
        *cloud.parameters, twist, log_gain, cloud.origin_mm, planes, overlaps, cutoff_sigma, exact
    )
    return pixels


def moved_planes(planes: Planes, twist: Tensor | None) -> Planes:
    """Planes after a twist [K, 6]: R <- R exp(w), t <- t + v."""
    if twist is None:
        return planes
    change = twist.detach().double().numpy()
    rotation = planes.rotation @ Rotation.from_rotvec(change[:, :3]).as_matrix()
    return planes.with_pose(RigidPose(rotation, planes.center_mm + change[:, 3:]))
