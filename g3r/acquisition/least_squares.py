"""A volume from posed slices: damped least squares with the voxel operator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.kernels_voxels import add_roughness, descend, turn
from g3r.acquisition.planes import Slices
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import VolumeGrid

SHARPENING_STEPS = 6
SHARPENING_SMOOTHNESS = 0.1

SHARP_CONVENTION = f"cg{SHARPENING_STEPS}-smoothness{SHARPENING_SMOOTHNESS:g}-v1"
"""How V_sharp follows from V_coarse; a prior trained with another convention is refused. See `sharpened_volume`."""


def sharpened_volume(
    slices: Slices,
    grid: VolumeGrid,
    coarse: NDArray[np.float32],
    gain: NDArray[np.floating] | None = None,
    weight: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """V_sharp: V_coarse after a few conjugate-gradient steps towards the slices.

    V_coarse (Eq. 6) is blurred twice by the slice profile: when it was measured and when it was accumulated.
    A few steps of regularised least squares undo what the slices determine and leave the rest to the prior
    network. Few steps and smoothness limit the noise.

    Args:
        slices: K slices.
        grid: of the volume.
        coarse: V_coarse [I, J, K], in the slices' intensities.
        gain: [K] intensity factor of each slice, divided out.
        weight: [P'] of each masked pixel, from 0 to 1.

    Returns:
        V_sharp [I, J, K] float32. Unlike V_coarse it may be negative, and it reaches a little beyond the support.
    """
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    value = slices.masked_value_without(gain)
    slice_weight = np.ones(len(value)) if weight is None else weight
    return solve_volume(
        operator,
        value.astype(np.float32),
        slice_weight.astype(np.float32),
        start=coarse,
        n_iterations=SHARPENING_STEPS,
        smoothness=SHARPENING_SMOOTHNESS,
    )


def solve_volume(
    operator: VoxelOperator,
    value: NDArray[np.float32],
    weight: NDArray[np.float32],
    *,
    smoothness: float,
    start: NDArray[np.float32] | None = None,
    n_iterations: int = 8,
) -> NDArray[np.float32]:
    """Minimise sum_p weight_p (A V - value)_p^2 + s ||grad V||^2 over volumes V [I, J, K].

    A few steps of conjugate gradients regularise by themselves. The smoothness is relative to the mean coverage of a
    voxel, so it depends neither on the number of slices nor on the grid.

    Args:
        operator: voxel forward operator for the P' pixels.
        value: [P'] intensities.
        weight: [P'] non-negative.
        smoothness: weight of squared differences of neighbouring voxels.
        start: volume to start from; zero when None.
        n_iterations: number of conjugate-gradient steps.
    """
    seen = operator.adjoint(weight.astype(np.float32))
    typical = float(seen[seen > 0.1 * seen.max(initial=0)].mean()) if seen.any() else 1.0
    strength = np.float32(smoothness * typical)
    along, square = (np.empty(operator.grid.shape[0]) for _ in range(2))

    def normal(volume: NDArray[np.float32]) -> NDArray[np.float32]:
        image = operator.adjoint(weight * operator.forward(volume))
        add_roughness(volume, strength, image, along)
        return image

    volume = np.zeros(operator.grid.shape, np.float32) if start is None else start.astype(np.float32, order="C")
    residual = operator.adjoint((weight * value).astype(np.float32)) - normal(volume)
    direction = residual.copy()
    norm = float(np.vdot(residual, residual))
    for _ in range(n_iterations):
        if norm == 0:
            break
        image = normal(direction)
        descend(volume, residual, direction, image, np.float32(norm / along.sum()), square)
        new_norm = float(square.sum())
        turn(direction, residual, np.float32(new_norm / norm))
        norm = new_norm
    return volume
