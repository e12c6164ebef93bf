"""The loss of a fit (G3R Eq. 1: data term plus regulariser) as a value and explicit gradients.

`CloudObjective.begin` returns a `LossStep` at the present parameters. `LossStep.add` evaluates an image term,
`LossStep.finish` adds the scale regulariser and writes the gradient of the sum into the parameters. The tests compare
it with the same loss through `render` and autograd.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.bias_basis import N_TERMS
from g3r.acquisition.planes import Planes
from g3r.fitting import kernels
from g3r.fitting.kernels import PixelArrays
from g3r.fitting.parameters import CLOUD_BLOCKS, FitParameters
from g3r.fitting.plane_state import PlaneState
from g3r.gaussians.arrays import CloudArrays, PlaneArrays, Workspace
from g3r.gaussians.kernels import N_GRADIENTS, N_PLANE_GRADIENTS, SHAPE_COLUMNS, derive_shapes
from g3r.gaussians.kernels_backward import shape_gradients
from g3r.gaussians.overlap import OverlapFinder, OverlapList
from g3r.gaussians.render import CUTOFF_SIGMA

OVERLAP_MARGIN_SIGMA = 1.0
"""Overlap lists are made with a cut-off larger by this, and made again before anything has moved by as much."""

TINY = float(np.finfo(np.float32).tiny)

EVERY = slice(None)
"""All planes of a term."""


@dataclass(frozen=True, kw_only=True)
class ImageTerm:
    """Mean weighted absolute difference of rendered planes and pixels.

    Attributes:
        planes: K planes.
        offset: [K] number of each plane's first pixel in `pixels`.
        pixels: targets, weights and field terms, possibly of more planes than these.
        total_weight: [K] sum of the weights of each plane's pixels.
        with_pose: whether gradients of poses are wanted.
        cutoff_sigma: where a Gaussian ends.
    """

    planes: Planes
    offset: NDArray[np.int64]
    pixels: PixelArrays
    total_weight: NDArray[np.float64]
    with_pose: bool
    cutoff_sigma: float

    @classmethod
    def of(
        cls,
        planes: Planes,
        value: NDArray[np.float32],
        weight: NDArray[np.float32],
        *,
        basis: NDArray[np.float32] | None = None,
        with_pose: bool = False,
        cutoff_sigma: float = CUTOFF_SIGMA,
    ) -> ImageTerm:
        """The term of all pixels of some planes.

        Args:
            planes: K planes.
            value: [P] their pixels.
            weight: [P] not negative; a pixel of weight zero does not count.
            basis: [5, P] terms of the planes' log-intensity fields; None without fields.
            with_pose: whether gradients of poses are wanted.
            cutoff_sigma: where a Gaussian ends.
        """
        pixels = PixelArrays(value, weight, np.zeros((N_TERMS, 0), np.float32) if basis is None else basis)
        total = np.add.reduceat(weight, planes.offset[:-1], dtype=np.float64)
        return cls(
            planes=planes,
            offset=planes.offset[:-1],
            pixels=pixels,
            total_weight=total,
            with_pose=with_pose,
            cutoff_sigma=cutoff_sigma,
        )

    def take(self, index: NDArray[np.integer]) -> ImageTerm:
        """The term of some of the planes."""
        return ImageTerm(
            planes=self.planes.take(index),
            offset=self.offset[index],
            pixels=self.pixels,
            total_weight=self.total_weight[index],
            with_pose=self.with_pose,
            cutoff_sigma=self.cutoff_sigma,
        )

    def mean(
        self,
        residual: NDArray[np.float64],
        slice_weight: NDArray[np.float64],
        chosen: NDArray[np.integer] | slice = EVERY,
    ) -> float:
        """The term of the chosen planes from sums of weight |difference| [K] and slice weights [K]."""
        return float(slice_weight[chosen] @ residual[chosen]) / self.scale(slice_weight, chosen)

    def scale(self, slice_weight: NDArray[np.float64], chosen: NDArray[np.integer] | slice = EVERY) -> float:
        """Sum of all weights of the chosen planes, which the term is divided by."""
        return max(float(slice_weight[chosen] @ self.total_weight[chosen]), TINY)


Terms = Mapping[str, tuple[ImageTerm, PlaneState]]
"""Image terms by name, each with the state of its planes."""


@dataclass(frozen=True)
class TermOverlaps:
    """The overlap list of a term, the planes that it was made for, and scratch space for them."""

    term: ImageTerm
    state: PlaneState
    overlaps: OverlapList
    work: Workspace


@dataclass(frozen=True, kw_only=True)
class TermLoss:
    """Value of an image term, and its gradients times the factor that it was added with.

    Attributes:
        mean: the term.
        chosen: [M] numbers of the planes whose mean it is; for the others the arrays below are zero.
        residual: [K] sums of weight |difference|.
        plane_gradient: [K, 7] of body-frame rotation (3), world translation (3) and log-gain.
        field_gradient: [K, 5] of the fields' coefficients.
    """

    mean: float
    chosen: NDArray[np.integer]
    residual: NDArray[np.float64]
    plane_gradient: NDArray[np.float64]
    field_gradient: NDArray[np.float32]


class CloudObjective:
    """The loss over a cloud, with derived shapes, gradient buffers and overlap lists.

    Args:
        parameters: whose gradient is written.
        scale_weight: of the scale regulariser: the mean squared log-ratio of each sigma to its value at the start. It
            keeps Gaussians that few pixels see from shrinking to needles or growing.
    """

    def __init__(self, parameters: FitParameters, scale_weight: float) -> None:
        n = len(parameters)
        self.parameters, self.scale_weight = parameters, scale_weight
        self.shapes = np.empty((n, SHAPE_COLUMNS))
        self.buffers = np.zeros((numba.get_num_threads(), n, N_GRADIENTS))
        self.seed_log_scale = parameters.value["log_scale"].copy()
        self.overlaps: dict[str, TermOverlaps] = {}
        self.n_searches = 0
        self._finders: dict[str, OverlapFinder] = {}
        self._then = np.zeros((n, 12))
        self._reach_mm = 0.0

    @property
    def _geometry(self) -> tuple[Any, ...]:
        value = self.parameters.value
        return value["mean_mm"], value["log_scale"], value["quaternion_wxyz"]

    def begin(self, terms: Terms) -> LossStep:
        """A step at the present parameters; overlap lists are made again if they may miss a Gaussian by then."""
        derive_shapes(*self._geometry, self.shapes)  # type: ignore[call-arg]
        self.buffers[:] = 0.0
        known = self.overlaps
        if any(name not in known or known[name].term is not terms[name][0] for name in terms) or self._moved(terms):
            self.overlaps = {name: self._search(name, *terms[name]) for name in terms}
            self._reach_mm = float(
                np.linalg.norm(self.parameters.value["mean_mm"], axis=1).max(initial=0.0)
                + max(np.linalg.norm(state.center_mm, axis=1).max(initial=0.0) for _, state in terms.values())
            )
            kernels.remember(*self._geometry, self._then)  # type: ignore[call-arg]
            self.n_searches += 1
        return LossStep(self, terms)

    def _search(self, name: str, term: ImageTerm, state: PlaneState) -> TermOverlaps:
        finder = self._finders.setdefault(name, OverlapFinder(len(self.shapes)))
        cutoff = term.cutoff_sigma + OVERLAP_MARGIN_SIGMA
        overlaps = finder.find(self.shapes, term.planes, state.rotation, state.center_mm, cutoff)
        return TermOverlaps(term, state, overlaps, Workspace.of(term.planes, overlaps.most))

    def _moved(self, terms: Terms) -> bool:
        # the largest movement of any plane, with the narrowest PSF of all: too early rather than too late
        farthest = kernels.farthest_move(  # type: ignore[call-arg]
            *self._geometry,
            self._then,
            max(term.cutoff_sigma for term, _ in terms.values()),
            max(state.moved_mm(self.overlaps[name].state, self._reach_mm) for name, (_, state) in terms.items()),
            min(float(term.planes.psf_var_mm2.min(initial=np.inf)) for term, _ in terms.values()),
        )
        return bool(farthest > OVERLAP_MARGIN_SIGMA)


@dataclass(frozen=True)
class LossStep:
    """One evaluation of the loss; made by `CloudObjective.begin`, valid until the next."""

    objective: CloudObjective
    terms: Terms

    def add(self, name: str, factor: float, chosen: NDArray[np.integer] | None = None) -> TermLoss:
        """An image term (without the factor); its gradient times the factor goes into the sum.

        Args:
            name: of the term.
            factor: weight of the term in the loss.
            chosen: [M] ascending numbers of the planes whose mean the term is; None for all.
        """
        (term, state), held = self.terms[name], self.objective.overlaps[name]
        n = len(term.planes)
        chosen = np.arange(n) if chosen is None else chosen
        planes = PlaneArrays(
            state.rotation,
            state.center_mm,
            state.gain,
            term.planes.psf_var_mm2,
            term.planes.shape,
            term.planes.spacing_mm,
            term.offset,
        )
        residual = np.zeros(n)
        plane_gradient, field_gradient = np.zeros((n, N_PLANE_GRADIENTS)), np.zeros((n, N_TERMS), np.float32)
        kernels.image_l1(
            CloudArrays(self.objective.shapes, self.objective.parameters.value["amplitude"]),
            planes,
            chosen,
            held.overlaps.arrays,
            term.cutoff_sigma**2,
            held.work,
            term.pixels,
            state.slice_weight,
            state.coefficients,
            factor / term.scale(state.slice_weight, chosen),
            term.with_pose,
            self.objective.buffers,
            plane_gradient,
            field_gradient,
            residual,
        )
        return TermLoss(
            mean=term.mean(residual, state.slice_weight, chosen),
            chosen=chosen,
            residual=residual,
            plane_gradient=plane_gradient,
            field_gradient=field_gradient,
        )

    def finish(self) -> float:
        """The scale regulariser times its weight; writes the gradient of the sum of all terms."""
        value, gradient = self.objective.parameters.value, self.objective.parameters.gradient
        shape_gradients(
            value["log_scale"],
            value["quaternion_wxyz"],
            self.objective.buffers,
            *(gradient[name] for name in CLOUD_BLOCKS),
        )
        share = self.objective.scale_weight / max(1, value["log_scale"].size)
        seed = self.objective.seed_log_scale
        return share * kernels.scale_penalty(value["log_scale"], seed, share, gradient["log_scale"])
