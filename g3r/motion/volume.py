"""A volume from posed slices: damped least squares with the voxel operator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid


def solve_volume(
    operator: VoxelOperator,
    value: NDArray[np.float32],
    weight: NDArray[np.float32],
    *,
    start: NDArray[np.float32] | None = None,
    n_iterations: int = 8,
    smoothness: float = 0.02,
) -> NDArray[np.float32]:
    """Minimise sum_p weight_p (A V - value)_p^2 + s ||grad V||^2 over volumes V [I, J, K].

    Conjugate gradients; few steps are a regulariser of their own. The smoothness is relative to how often a
    voxel is seen on average, so it depends neither on the number of slices nor on the grid.

    Args:
        operator: voxel forward operator for the P' pixels.
        value: [P'] intensities.
        weight: [P'] non-negative.
        start: volume to start from; zero when None.
        n_iterations: number of conjugate-gradient steps.
        smoothness: weight of squared differences of neighbouring voxels.
    """
    seen = operator.adjoint(weight.astype(np.float32))
    typical = float(seen[seen > 0.1 * seen.max(initial=0)].mean()) if seen.any() else 1.0
    strength = np.float32(smoothness * typical)

    def normal(volume: NDArray[np.float32]) -> NDArray[np.float32]:
        return operator.adjoint(weight * operator.forward(volume)) + strength * _laplacian(volume)

    volume = np.zeros(operator.grid.shape, np.float32) if start is None else start.astype(np.float32)
    residual = operator.adjoint((weight * value).astype(np.float32)) - normal(volume)
    direction = residual.copy()
    norm = float(np.vdot(residual, residual))
    for _ in range(n_iterations):
        if norm == 0:
            break
        image = normal(direction)
        step = norm / float(np.vdot(direction, image))
        volume = volume + np.float32(step) * direction
        residual -= np.float32(step) * image
        new_norm = float(np.vdot(residual, residual))
        direction = residual + np.float32(new_norm / norm) * direction
        norm = new_norm
    return volume


def _laplacian(volume: NDArray[np.float32]) -> NDArray[np.float32]:
    """D^T D V with forward differences D and free edges."""
    out = np.zeros_like(volume)
    for axis in range(3):
        difference = np.diff(volume, axis=axis)
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        out[tuple(low)] -= difference
        out[tuple(high)] += difference
    return out


def grid_around(slices: Slices, spacing_mm: float, margin_mm: float = 6.0) -> VolumeGrid:
    """The axis-aligned grid that covers every masked pixel and a margin."""
    points = slices.planes.pixel_world_mm(slices.pixel_index)
    return VolumeGrid.isotropic(points.min(0), points.max(0), spacing_mm, margin_mm)
