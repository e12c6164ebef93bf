"""The loss of a fit as a value and explicit gradients, in memory that is taken once.

A step calls `CloudObjective.begin`, `ImageTerm.add` for each image term, and `CloudObjective.finish`; then
the parameters' gradient is that of the sum. The same loss through `render()` and autograd is the oracle of
the tests.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Planes
from g3r.fitting import kernels
from g3r.fitting.parameters import FitParameters
from g3r.gaussians.kernels import N_GRADIENTS, N_PLANE_GRADIENTS, SHAPE_COLUMNS, derive_shapes
from g3r.gaussians.kernels_backward import shape_gradients
from g3r.gaussians.overlap import OverlapFinder, OverlapList, Workspace
from g3r.gaussians.render import CUTOFF_SIGMA

PAIR_MARGIN_SIGMA = 1.0
"""Pair lists are built this much beyond the cut-off, and again before anything has moved by as much."""

N_FIELD_TERMS = 5
"""Coefficients of an intensity field (`bias_field`)."""

TINY = float(np.finfo(np.float32).tiny)


class ImageTerm:
    """Mean weighted absolute difference of rendered planes and pixels, with the gradients of everything.

    What `add` leaves in `residual` [K] (sums of weight |difference|), `plane_gradient` [K, 7] and
    `field_gradient` [K, 5] is that of the last step. The attributes rotation, center_mm (from the cloud's
    origin), gain, trust and coefficients [K, ...] may be set between steps; `moved_mm` bounds how far the
    planes' pixels have moved since pairs were last sought.

    Args:
        planes: K planes.
        value: [P] their pixels.
        weight: [P], not negative; zero leaves a pixel out.
        origin_mm: of the cloud.
        basis: [5, P] terms of the planes' log-intensity fields; None where there are none.
        with_pose: whether gradients of poses are wanted.
        exact: the amplitude, as in `render`.
        cutoff_sigma: where a Gaussian ends.
    """

    moved_mm = 0.0

    def __init__(
        self,
        planes: Planes,
        value: NDArray[np.float32],
        weight: NDArray[np.float32],
        origin_mm: NDArray[np.float64],
        *,
        basis: NDArray[np.float32] | None = None,
        with_pose: bool = False,
        exact: bool = True,
        cutoff_sigma: float = CUTOFF_SIGMA,
    ) -> None:
        self.every, self.value, self.weight, self.origin_mm = planes, value, weight, origin_mm
        self.with_pose, self.exact, self.cutoff_sigma = with_pose, exact, cutoff_sigma
        self.basis = np.zeros((N_FIELD_TERMS, 0), np.float32) if basis is None else basis
        self.weight_of_plane = np.add.reduceat(weight, planes.offset[:-1], dtype=np.float64)
        self.finder: OverlapFinder | None = None
        self.work: Workspace | None = None
        self.choose(np.arange(len(planes)))

    def choose(self, index: NDArray[np.integer]) -> None:
        """Let only these planes count, where they stand at first; pairs must be sought again."""
        n = len(index)
        self.planes, self.offset = self.every.take(index), self.every.offset[index]
        self.total = self.weight_of_plane[index]
        self.rotation, self.center_mm = self.planes.rotation, self.planes.center_mm - self.origin_mm
        self.gain, self.slice_weight = np.ones(n), np.ones(n)
        self.coefficients = np.zeros((n, N_FIELD_TERMS), np.float32)
        self.plane_gradient = np.zeros((n, N_PLANE_GRADIENTS))
        self.field_gradient = np.zeros((n, N_FIELD_TERMS), np.float32)
        self.residual = np.zeros(n)
        self.pairs: OverlapList | None = None

    @property
    def min_psf_mm2(self) -> float:
        """Least variance of the PSF in any direction."""
        return float(self.planes.psf_var_mm2.min(initial=np.inf))

    def find_overlaps(self, shapes: NDArray[np.float64]) -> None:
        """Search the pairs of the present planes, with the margin."""
        self.finder = self.finder or OverlapFinder(len(shapes))
        cutoff = self.cutoff_sigma + PAIR_MARGIN_SIGMA
        self.pairs = self.finder.find(shapes, self.planes, self.rotation, self.center_mm, cutoff)
        if self.work is None or self.work.projections.shape[1] < self.pairs.most:
            self.work = Workspace.of(self.every, self.pairs.most + self.pairs.most // 8)

    def add(
        self, shapes: NDArray[np.float64], amplitude: NDArray[np.float32], buffers: NDArray[np.float64], factor: float
    ) -> float:
        """The term, as a mean; adds factor times its gradient to the buffers of the Gaussians."""
        assert self.pairs is not None, "begin first"
        assert self.work is not None
        total = max(float(self.slice_weight @ self.total), TINY)
        planes = self.planes
        kernels.image_l1(
            shapes,
            amplitude,
            self.rotation,
            self.center_mm,
            self.gain,
            planes.psf_var_mm2,
            planes.shape,
            planes.spacing_mm,
            self.offset,
            self.pairs.start,
            self.pairs.gaussian,
            self.cutoff_sigma**2,
            self.exact,
            self.work.images,
            self.work.projections,
            self.value,
            self.weight,
            self.slice_weight,
            factor / total,
            self.with_pose,
            self.basis,
            self.coefficients,
            buffers,
            self.plane_gradient,
            self.field_gradient,
            self.residual,
        )
        return float(self.slice_weight @ self.residual) / total


class CloudObjective:
    """What all terms of a loss share: derived shapes, gradient buffers, and when pairs are sought again.

    Args:
        parameters: whose gradient is made.
        terms: all image terms.
        scale_weight: of the scale regulariser, the mean squared logarithm of how far each sigma has gone from
            where it is now; it keeps Gaussians that few pixels see from shrinking to needles or growing.
    """

    def __init__(self, parameters: FitParameters, terms: list[ImageTerm], scale_weight: float) -> None:
        n = len(parameters)
        self.parameters, self.terms, self.scale_weight = parameters, terms, scale_weight
        self.shapes = np.empty((n, SHAPE_COLUMNS))
        self.buffers = np.zeros((numba.get_num_threads(), n, N_GRADIENTS))
        self.seed_log_scale = parameters.value["log_scale"].copy()
        self.then = np.zeros((n, 12))
        self.n_searches = 0

    @property
    def _geometry(self) -> tuple[Any, ...]:
        value = self.parameters.value
        return value["mean_mm"], value["log_scale"], value["quaternion_wxyz"]

    def begin(self) -> None:
        """Derive the shapes of the present parameters; search pairs if any may have been missed by now."""
        derive_shapes(*self._geometry, self.shapes)  # type: ignore[call-arg]
        self.buffers[:] = 0.0
        if any(term.pairs is None for term in self.terms) or self._have_moved():
            for term in self.terms:
                term.find_overlaps(self.shapes)
            kernels.remember(*self._geometry, self.then)  # type: ignore[call-arg]
            self.n_searches += 1

    def _have_moved(self) -> bool:
        # the largest shift of any plane goes with the narrowest PSF of all: too early rather than too late
        farthest = kernels.farthest_move(  # type: ignore[call-arg]
            *self._geometry,
            self.then,
            max(term.cutoff_sigma for term in self.terms),
            max(term.moved_mm for term in self.terms),
            min(term.min_psf_mm2 for term in self.terms),
        )
        return farthest > PAIR_MARGIN_SIGMA

    def add(self, term: ImageTerm, factor: float) -> float:
        """An image term (without the factor); its gradient times the factor goes into the sum."""
        return term.add(self.shapes, self.parameters.value["amplitude"], self.buffers, factor)

    def finish(self) -> float:
        """The scale regulariser times its weight; writes the gradient of the sum of all terms."""
        value, gradient = self.parameters.value, self.parameters.gradient
        shape_gradients(
            value["log_scale"],
            value["quaternion_wxyz"],
            self.buffers,
            gradient["amplitude"],
            gradient["mean_mm"],
            gradient["log_scale"],
            gradient["quaternion_wxyz"],
        )
        share = self.scale_weight / max(1, value["log_scale"].size)
        return share * kernels.scale_penalty(value["log_scale"], self.seed_log_scale, share, gradient["log_scale"])
