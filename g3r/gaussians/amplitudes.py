"""Amplitudes by linear least squares: the model is linear in c once shapes and poses are given."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.gaussians import kernels_amplitudes as kernels
from g3r.gaussians.arrays import CloudArrays, PlaneArrays, Workspace
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.kernels import PROJECTION
from g3r.gaussians.kernels_amplitudes import HeldProjections
from g3r.gaussians.overlap import OverlapList, find_overlaps
from g3r.gaussians.render import CUTOFF_SIGMA
from g3r.run.on_demand import torch

MAX_PROJECTION_BYTES = 400_000_000
"""Gaussians are projected once for all products if their projections take no more than this."""


class AmplitudeSystem:
    """The linear map A from amplitudes [N] to pixels [P] and its exact adjoint (CPU).

    Args:
        cloud: its shapes; its amplitudes are not read.
        planes: K planes.
        gain: [K] intensity factors; 1 when None.
        overlaps: list from `find_overlaps`; made here when None.
        cutoff_sigma: where a Gaussian ends.
        projection_bytes: memory for projections; if they need more, they are made again in every product.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        planes: Planes,
        *,
        gain: NDArray[np.floating] | None = None,
        overlaps: OverlapList | None = None,
        cutoff_sigma: float = CUTOFF_SIGMA,
        projection_bytes: int = MAX_PROJECTION_BYTES,
    ) -> None:
        overlaps = find_overlaps(cloud, planes, cutoff_sigma) if overlaps is None else overlaps
        self.n_gaussians, self.n_pixels = len(cloud), planes.n_pixels
        self.cut = cutoff_sigma**2
        self.shapes = CloudArrays.of(cloud).shapes
        self.planes, self.overlaps = PlaneArrays.of(planes, cloud.origin_mm, gain), overlaps.arrays
        self.parts = _parts(overlaps.start, projection_bytes // PROJECTION.itemsize)
        longest = max((int(overlaps.start[b] - overlaps.start[a]) for a, b in self.parts), default=0)
        self.held = HeldProjections(overlaps.start, np.zeros(longest, PROJECTION), np.zeros(len(planes), np.int64))
        self.images = Workspace.of(planes, 0).images
        self.is_set_up = False

    def _set_up_parts(self) -> Iterator[tuple[int, int]]:
        """Ranges of planes whose projections are held while each is yielded."""
        for part in self.parts:
            if not self.is_set_up:
                _, projections, n_touching = self.held
                kernels.set_up(part, self.shapes, self.planes, self.overlaps, self.cut, projections, n_touching)
            yield part
        self.is_set_up = len(self.parts) == 1

    def forward(self, amplitude: NDArray[np.floating]) -> NDArray[np.float32]:
        """Pixels [P] of amplitudes [N]."""
        out = np.empty(self.n_pixels, np.float32)
        single = amplitude.astype(np.float32)
        for part in self._set_up_parts():
            kernels.apply(part, single, self.planes, self.cut, self.held, self.images, out)
        return out

    def adjoint(self, pixels: NDArray[np.float32]) -> NDArray[np.float64]:
        """A^T of pixels [P], as [N] float64."""
        buffers = np.zeros((len(self.images), self.n_gaussians))
        weight = np.ascontiguousarray(pixels, dtype=np.float32)
        for part in self._set_up_parts():
            kernels.apply_adjoint(part, weight, self.planes, self.cut, self.held, self.images, buffers)
        return buffers.sum(0)


def _parts(start: NDArray[np.int64], max_pairs: int) -> list[tuple[int, int]]:
    """Ranges of planes (first, one past the last) with at most `max_pairs` pairs each, or of one plane."""
    parts, first = [], 0
    while first < len(start) - 1:
        last = int(np.searchsorted(start, start[first] + max_pairs, side="right")) - 1
        last = min(max(last, first + 1), len(start) - 1)
        parts.append((first, last))
        first = last
    return parts


def solve_amplitudes(
    cloud: GaussianCloud,
    planes: Planes,
    target: NDArray[np.float32],
    weight: NDArray[np.float32],
    *,
    gain: NDArray[np.floating] | None = None,
    n_iterations: int = 10,
    damping: float = 1e-3,
    overlaps: OverlapList | None = None,
    cutoff_sigma: float = CUTOFF_SIGMA,
    projection_bytes: int = MAX_PROJECTION_BYTES,
) -> GaussianCloud:
    """The cloud with the amplitudes that minimise sum_p weight_p (A c - target)_p^2 + damping d ||c - c_0||^2.

    Conjugate gradients on the normal equations, started at the cloud's own amplitudes c_0. d is the mean diagonal
    of A^T W A as one product with a vector of ones estimates it, so that the damping is a pure number.

    Args:
        cloud: shapes, and the amplitudes to start from.
        planes: K planes.
        target: [P] pixels.
        weight: [P] non-negative; zero leaves a pixel out.
        gain: [K] intensity factor of each plane.
        n_iterations: largest number of products with A and A^T.
        damping: relative; above zero, Gaussians that no pixel sees stay at their amplitudes.
        overlaps: list from `find_overlaps`.
        cutoff_sigma: as in `render`.
        projection_bytes: see `AmplitudeSystem`; less memory, more seconds, the same result.

    Source: Hestenes and Stiefel (1952), in the CGLS order of operations (Bjoerck 1996, 7.4.1).
    """
    system = AmplitudeSystem(
        cloud, planes, gain=gain, overlaps=overlaps, cutoff_sigma=cutoff_sigma, projection_bytes=projection_bytes
    )
    start = cloud.amplitude.detach().double().numpy()
    residual = target.astype(np.float64) - system.forward(start)
    row_sum = system.adjoint(weight * system.forward(np.ones(len(cloud), np.float32)))
    seen = float(np.abs(row_sum).sum())
    if not seen > 0:  # no pixel sees any Gaussian, or there is none
        return cloud
    shift = damping * seen / len(cloud)
    step = np.zeros_like(start)
    gradient = system.adjoint((weight * residual).astype(np.float32))
    direction = gradient.copy()
    norm = first = float(gradient @ gradient)
    for _ in range(n_iterations):
        if norm <= 1e-10 * first or norm == 0:
            break
        image = system.forward(direction).astype(np.float64)
        curvature = float(weight @ image**2) + shift * float(direction @ direction)
        if not curvature > 0:  # the rest of the gradient is rounding, in a direction that changes nothing
            break
        length = norm / curvature
        step += length * direction
        residual -= length * image
        gradient = system.adjoint((weight * residual).astype(np.float32)) - shift * step
        new_norm = float(gradient @ gradient)
        direction = gradient + new_norm / norm * direction
        norm = new_norm
    return cloud.with_amplitude(torch.from_numpy((start + step).astype(np.float32)))
