"""Amplitudes by linear least squares: the model is linear in c once shapes and poses are given."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.gaussians import kernels
from g3r.gaussians import kernels_amplitudes as kernels_amplitudes
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.overlap import CloudArrays, OverlapList, Workspace, find_overlaps
from g3r.gaussians.render import CUTOFF_SIGMA, plane_arguments

MAX_PROJECTION_BYTES = 400_000_000
"""Pairs are set up once and kept for all products if their records take no more than this."""


class AmplitudeSystem:
    """The linear map from amplitudes [N] to pixels [P] and its exact adjoint (CPU)."""

    def __init__(
        self,
        cloud: GaussianCloud,
        planes: Planes,
        gain: NDArray[np.floating] | None,
        pairs: OverlapList,
        cutoff_sigma: float,
        exact: bool,
        projection_bytes: int = MAX_PROJECTION_BYTES,
    ) -> None:
        self.n_gaussians, self.n_pixels = len(cloud), planes.n_pixels
        self.cut, self.exact = cutoff_sigma**2, exact
        factor = np.asarray(np.ones(len(planes)) if gain is None else gain, dtype=np.float64)
        self.shapes = CloudArrays.of(cloud).shapes
        self.described = plane_arguments(planes, planes.center_mm - cloud.origin_mm, factor, pairs)
        self.layout = (planes.shape, planes.offset, pairs.start)
        self.parts = _parts(pairs.start, projection_bytes // kernels.PAIR.itemsize)
        longest = max((int(pairs.start[b] - pairs.start[a]) for a, b in self.parts), default=0)
        self.projections = np.zeros(longest, kernels.PAIR)
        self.count = np.zeros(len(planes), np.int64)
        self.images = Workspace.of(planes, 0).images
        self.is_set_up = False

    @classmethod
    def of(
        cls,
        cloud: GaussianCloud,
        planes: Planes,
        gain: NDArray[np.floating] | None = None,
        pairs: OverlapList | None = None,
        cutoff_sigma: float = CUTOFF_SIGMA,
        attenuation: str = "exact",
        projection_bytes: int = MAX_PROJECTION_BYTES,
    ) -> AmplitudeSystem:
        """The system for the shapes of a cloud (its amplitudes are not read)."""
        if pairs is None:
            pairs = find_overlaps(cloud, planes, cutoff_sigma)
        return cls(cloud, planes, gain, pairs, cutoff_sigma, attenuation == "exact", projection_bytes)

    def _set_up_parts(self) -> Iterator[tuple[int, int]]:
        """Ranges of planes, each with its records in place; one range of all where they can be kept."""
        for first, last in self.parts:
            if not self.is_set_up:
                kernels_amplitudes.set_up(  # type: ignore[call-arg]
                    first, last, self.shapes, *self.described, self.cut, self.exact, self.projections, self.count
                )
            yield first, last
        self.is_set_up = len(self.parts) == 1

    def forward(self, amplitude: NDArray[np.floating]) -> NDArray[np.float32]:
        """Pixels [P] of amplitudes [N]."""
        out = np.empty(self.n_pixels, np.float32)
        single = amplitude.astype(np.float32)
        for first, last in self._set_up_parts():
            kernels_amplitudes.apply(
                first, last, single, *self.layout, self.cut, self.projections, self.count, self.images, out
            )
        return out

    def adjoint(self, pixels: NDArray[np.float32]) -> NDArray[np.float64]:
        """A^T of pixels [P], as [N] float64."""
        buffers = np.zeros((len(self.images), self.n_gaussians))
        weight = np.ascontiguousarray(pixels, dtype=np.float32)
        for first, last in self._set_up_parts():
            kernels_amplitudes.apply_adjoint(
                first, last, weight, *self.layout, self.cut, self.projections, self.count, self.images, buffers
            )
        return buffers.sum(0)


def _parts(start: NDArray[np.int64], max_pairs: int) -> list[tuple[int, int]]:
    """Ranges of planes with at most so many pairs each (or one plane)."""
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
    pairs: OverlapList | None = None,
    cutoff_sigma: float = CUTOFF_SIGMA,
    attenuation: str = "exact",
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
        n_iterations: at most so many products with A and A^T.
        damping: relative; above zero keeps Gaussians that no pixel sees where they were.
        pairs: list from `find_overlaps`.
        cutoff_sigma: as in `render`.
        attenuation: as in `render`.
        projection_bytes: pairs are set up once if that takes no more memory, else again in every product.

    Source: Hestenes and Stiefel (1952), in the CGLS order of operations (Bjoerck 1996, 7.4.1).
    """
    system = AmplitudeSystem.of(cloud, planes, gain, pairs, cutoff_sigma, attenuation, projection_bytes)
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
        if not curvature > 0:  # what is left of the gradient is rounding, in a direction that changes nothing
            break
        length = norm / curvature
        step += length * direction
        residual -= length * image
        gradient = system.adjoint((weight * residual).astype(np.float32)) - shift * step
        new_norm = float(gradient @ gradient)
        direction = gradient + new_norm / norm * direction
        norm = new_norm
    return cloud.with_amplitude(torch.from_numpy((start + step).astype(np.float32)))
