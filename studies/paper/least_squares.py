"""Baselines without a network: super-resolution by least squares, with Tikhonov's regulariser and with total variation.

    minimise over V:  sum_p w_p (A V - y)_p^2  +  s r sum of rho(grad V)

rho is the square of the gradient's length (Tikhonov), or the length with a rounded tip (total variation). Total
variation is solved as a sequence of weighted least-squares problems (lagged diffusivity, Vogel and Oman 1996). A is
g3r's own operator with the slice profile of the product's fit, r the mean coverage of a voxel. The surroundings of the
brain are not subtracted from the pixels of the rim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg

from g3r.acquisition.total_variation import diffusivity, divergence_of_gradient
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.slice_targets import SliceModel

Float32Array = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Regulariser:
    """Regulariser of a least-squares volume.

    Args:
        strength: s; relative, so that it does not depend on the number of slices.
        tip: gradient length (of intensities of order one, from voxel to voxel) below which total variation is
            rounded; None for Tikhonov.
        n_rounds: number of solutions, each with the weights from the previous one.
        n_iterations: conjugate-gradient steps per solution.
    """

    strength: float
    tip: float | None = None
    n_rounds: int = 1
    n_iterations: int = 20


def least_squares_volume(
    volumes: InitialVolumes,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    regulariser: Regulariser,
    widths: Sequence[float] | None = None,
) -> Float32Array:
    """The volume [I, J, K] on the grid of the initial volumes, started from V_coarse.

    Args:
        volumes: initial volumes of the posed slices.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        regulariser: Tikhonov or total variation.
        widths: of each stack's profile through the plane, see `SliceModel.applied`.
    """
    slices, grid = SliceModel().applied(volumes.slices, widths), volumes.grid
    operator = VoxelOperator(slices.planes, grid, slices.pixel_index)
    pixel_weight = weight[slices.pixel_plane].astype(np.float32)
    value = slices.masked_value_without(gain).astype(np.float32)
    seen = operator.adjoint(pixel_weight)
    strength = np.float32(regulariser.strength * float(seen[seen > 0.1 * seen.max()].mean()))
    target = operator.adjoint(pixel_weight * value)

    def solved(start: Float32Array, edges: Float32Array | None) -> Float32Array:
        def normal(flat: NDArray[np.floating]) -> Float32Array:
            volume = flat.reshape(grid.shape).astype(np.float32)
            data = operator.adjoint(pixel_weight * operator.forward(volume).astype(np.float32))
            return (data + strength * divergence_of_gradient(volume, edges)).ravel().astype(np.float32)

        system = LinearOperator((target.size, target.size), matvec=normal, dtype=np.float32)
        found, _ = cg(system, target.ravel(), x0=start.ravel(), maxiter=regulariser.n_iterations, rtol=1e-4)
        return np.asarray(found, np.float32).reshape(grid.shape)

    volume = volumes.coarse
    for _ in range(regulariser.n_rounds):
        volume = solved(volume, None if regulariser.tip is None else diffusivity(volume, regulariser.tip))
    return volume


TIKHONOV = Regulariser(strength=0.03, n_iterations=25)
TOTAL_VARIATION = Regulariser(strength=0.01, tip=0.02, n_rounds=4, n_iterations=12)


def tuned(atlas: bool, n_stacks: int) -> tuple[Regulariser, Regulariser]:
    """Tikhonov and total variation with the strengths that `studies.paper.tuning` found best on other subjects.

    Args:
        atlas: True for atlas volumes, False for phantoms, whose tissues have almost uniform intensity.
        n_stacks: of the subject.
    """
    if not atlas:
        return (TIKHONOV if n_stacks > 1 else replace(TIKHONOV, strength=0.01)), TOTAL_VARIATION
    return replace(TIKHONOV, strength=0.1), replace(TOTAL_VARIATION, strength=0.03 if n_stacks == 1 else 0.01)
