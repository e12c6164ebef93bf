"""The renderer as a function that torch differentiates."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from g3r.acquisition.planes import Planes
from g3r.gaussians import kernels, kernels_backward
from g3r.gaussians.arrays import CloudArrays, PlaneArrays, Workspace
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.overlap import OverlapList
from g3r.gaussians.render import moved_planes
from g3r.geometry.rigid import right_jacobian


class RenderFunction(torch.autograd.Function):
    """Pixels of planes, and the gradients of a loss by Gaussians, poses and gains; see `render`."""

    @staticmethod
    def forward(
        ctx: Any,
        mean: Tensor,
        log_scale: Tensor,
        quaternion: Tensor,
        amplitude: Tensor,
        twist: Tensor | None,
        log_gain: Tensor | None,
        origin_mm: NDArray[np.float64],
        planes: Planes,
        overlaps: OverlapList,
        cutoff_sigma: float,
        exact: bool,
    ) -> Tensor:
        """Pixels [P]; arguments as those of `render`."""
        moved = moved_planes(planes, twist)
        gain = np.ones(len(planes)) if log_gain is None else np.exp(log_gain.detach().double().numpy())
        cloud = GaussianCloud.of((mean, log_scale, quaternion, amplitude), origin_mm)
        work = Workspace.of(planes, overlaps.most)
        given = (CloudArrays.of(cloud), PlaneArrays.of(moved, origin_mm, gain), overlaps.arrays, cutoff_sigma**2, exact)
        out = np.zeros(planes.n_pixels, np.float32)
        kernels.forward(*given, work, out)
        ctx.saved = (given, work, cloud, twist)
        ctx.like = [None if p is None else p.dtype for p in (mean, log_scale, quaternion, amplitude, twist, log_gain)]
        return torch.from_numpy(out).to(mean.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients by moments; see `kernels_backward.backward`."""
        given, work, cloud, twist = ctx.saved
        n, n_planes = len(cloud), len(given[1].rotation)
        buffers = np.zeros((len(work.images), n, kernels.N_GRADIENTS))
        plane_gradient = np.zeros((n_planes, kernels.N_PLANE_GRADIENTS))
        weight = np.ascontiguousarray(grad.detach().numpy(), dtype=np.float32)
        kernels_backward.backward(*given, work, weight, buffers, plane_gradient)  # type: ignore[call-arg]
        found = [np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)), np.empty(n)]
        log_scale, quaternion = (np.ascontiguousarray(p.detach().numpy()) for p in cloud.parameters[1:3])
        kernels_backward.shape_gradients(log_scale, quaternion, buffers, *found)
        pose = plane_gradient[:, :6]
        if twist is not None:
            # the kernels differentiate by a rotation after the present one: exp(w + dw) = exp(w) exp(J_r dw)
            jacobian = right_jacobian(twist.detach().double().numpy()[:, :3])
            pose = np.concatenate([np.einsum("kji,kj->ki", jacobian, pose[:, :3]), pose[:, 3:]], axis=1)
        arrays = (*found, pose, plane_gradient[:, 6])
        gradients = [
            None if dtype is None else torch.from_numpy(np.ascontiguousarray(array)).to(dtype)
            for array, dtype in zip(arrays, ctx.like, strict=True)
        ]
        return (*gradients, None, None, None, None, None)
