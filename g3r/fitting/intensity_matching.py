"""Intensity matching: gains of slices and fields of stacks, as far as slices that cross determine them.

Registration finds gains along with poses, but from slices whose slow trends were divided out
(`registration.bias_correction`), and with them slow changes of the anatomy. For the next stages gains are found anew,
from the original slices in their poses: where slices of several stacks cross, their log-intensities differ by the gains
of the slices and by the fields of their stacks.

Not all of that is determined. With three orthogonal stacks, a volume that is shaded along x or x^2, or the same in y or
z, with gains and fields that compensate for it, explains the same pixels. That part is set to zero after every round;
the volume keeps such shading until `common_bias_field` removes it. Otherwise it would grow round by round, because a
blurred volume is less dark than the slices where the head ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from g3r.acquisition.bias_basis import LENGTH_MM, N_TERMS
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.neighbour_gains import MIN_INTENSITY, neighbour_gains

Float64Array = NDArray[np.float64]

VOXEL_MM = 2.5
"""About the slice thickness: what differs between slices that cross within a voxel is mostly gain and field."""

MAX_PIXELS = 60_000
"""Largest number of pixels in use, evenly spread; hundreds of each slice."""

MIN_STACKS = 3
"""Fewest stacks that are matched. Two stacks leave more open, and their poses are less certain: with matching, eight
simulated subjects lost 0.15 dB in the mean, and real stacks were predicted 0.1 to 0.2 dB worse by two others."""

N_ROUNDS = 6
"""Rounds of volume, gains and fields. What crossing slices determine least converges slowly."""

SHARED = 0.3
"""A quadratic shading is undetermined if gains and fields can show all but less than this share of it."""

MIN_VARIANCE = 0.1
"""Lower bound of the variance at a place, over the usual one: a few pixels that agree by chance must not decide."""

RIDGE = 1e-3
"""Ridge of the coefficients of a field, over what its pixels measure: a line of pixels does not determine y."""


@dataclass(frozen=True, kw_only=True)
class MatchedIntensities:
    """Slices whose intensities agree where they cross.

    Attributes:
        slices: K slices, with the fields of their stacks divided out.
        gain: [K] intensity factors, not divided out.
        coefficients: [N][5] of the fields that were divided out, see `StackBiasField`; empty where nothing was matched.
    """

    slices: Slices
    gain: Float64Array
    coefficients: list[list[float]]


def match_intensities(slices: Slices, gain: Float64Array, weight: NDArray[np.floating]) -> MatchedIntensities:
    """Gains and fields from slices in place.

    Args:
        slices: K slices; those of two stacks stay as they are, and one stack gets its gains from `neighbour_gains`.
        gain: [K] intensity factors to start with; with three stacks or more, slices without weight keep them.
        weight: [K] slice weights.
    """
    counts = weight[slices.pixel_plane] > 0
    if slices.n_stacks == 1:
        return MatchedIntensities(slices=slices, gain=neighbour_gains(slices), coefficients=[])
    if slices.n_stacks < MIN_STACKS or not counts.any():
        return MatchedIntensities(slices=slices, gain=gain, coefficients=[])
    index = slices.pixel_index[counts]
    pixels = _Pixels(slices, index[thinned(len(index), MAX_PIXELS)], weight)
    factors = pixels.without_shared(pixels.fitted(np.log(gain)[pixels.plane], pixels.weight))
    for _ in range(N_ROUNDS):
        off = pixels.off(factors)
        left = off - pixels.of(factors)
        robust = 1 / (1 + (left / robust_width(left, n_sigma=2)) ** 2)
        factors = pixels.without_shared(pixels.fitted(off, pixels.weight * robust * pixels.agreement(left)))
    log_gain = np.where(pixels.measured, factors.log_gain, np.log(gain))
    field = np.exp(pixels.fields.log_field(factors.coefficients))
    return MatchedIntensities(
        slices=replace(slices, value=(slices.value / field).astype(np.float32)),
        gain=np.asarray(np.exp(log_gain - log_gain.mean())),
        coefficients=factors.coefficients.tolist(),
    )


@dataclass(frozen=True)
class _Factors:
    """log_gain [K] of the slices and coefficients [N, 5] of the fields of their stacks."""

    log_gain: Float64Array
    coefficients: Float64Array


class _Pixels:
    """P' pixels that gains and fields are fitted to.

    Args:
        slices: K slices.
        index: [P'] numbers of the pixels.
        weight: [K] slice weights.
    """

    def __init__(self, slices: Slices, index: NDArray[np.int64], weight: NDArray[np.floating]) -> None:
        self.fields = StackBiasField(slices)
        self.n_slices = len(slices)
        self.operator = VoxelOperator(slices.planes, grid_around(slices, VOXEL_MM, VOXEL_MM), index, (1, 1, 1))
        self.plane = self.operator.plane
        self.weight = weight[self.plane].astype(np.float64)
        self.seen = self.operator.adjoint(self.weight.astype(np.float32))
        self.measured = np.bincount(self.plane, self.weight, self.n_slices) > 0
        value = slices.value[index].astype(np.float64)
        self.log_value = np.log(np.maximum(value, MIN_INTENSITY * value.mean()))
        self.terms = self.fields.basis[:, index].T.astype(np.float64)
        _, self.stack = np.unique(slices.stack_id, return_inverse=True)
        self.rows = [np.flatnonzero(self.stack[self.plane] == n) for n in range(len(self.fields.stacks))]
        # every stack counts alike, however many pixels it has
        self.alike = self.weight.copy()
        for rows in self.rows:
            self.alike[rows] /= max(float(self.alike[rows].sum()), 1e-30)
        self.shading = self._shared_shading(slices.planes.pixel_world_mm(index) / LENGTH_MM)

    def _shared_shading(self, place: Float64Array) -> Float64Array:
        """Quadratics of places [P', 3] that gains and fields can show in every stack: [P', n], orthonormal."""
        place = place - np.average(place, axis=0, weights=self.alike)
        terms = np.column_stack([place, *(place[:, i] * place[:, j] for i in range(3) for j in range(i, 3))])
        terms -= np.average(terms, axis=0, weights=self.alike)
        left = np.column_stack([term - self.of(self.fitted(term, self.alike)) for term in terms.T])
        whole = (terms.T * self.alike) @ terms
        share, mode = eigh((left.T * self.alike) @ left, whole + 1e-6 * np.trace(whole) * np.eye(len(whole)))
        return np.asarray(terms @ mode[:, share < SHARED])

    def of(self, factors: _Factors) -> Float64Array:
        """The sum of gains and fields [P'] at each pixel."""
        own = factors.coefficients[self.stack[self.plane]]
        return factors.log_gain[self.plane] + np.einsum("pi,pi->p", own, self.terms)

    def off(self, factors: _Factors) -> Float64Array:
        """Log-intensities [P'] relative to the volume that pixels give with these factors."""
        volume = self.operator.adjoint((self.weight * (self.log_value - self.of(factors))).astype(np.float32))
        np.divide(volume, self.seen, out=volume, where=self.seen > 0)
        return self.log_value - self.operator.forward(volume)

    def agreement(self, left: Float64Array) -> Float64Array:
        """Weight [P'] of pixels by their place: one over the mean square of residuals there, usually 1.

        Slices disagree at edges, most of all in the rim of skull and fluid that manual masks include.
        """
        square = self.operator.adjoint((self.weight * np.minimum(left**2, 1)).astype(np.float32))
        np.divide(square, self.seen, out=square, where=self.seen > 0)
        variance = self.operator.forward(square).astype(np.float64)
        usual = float(np.median(variance))
        return usual / np.maximum(variance, MIN_VARIANCE * usual + 1e-12)

    def fitted(self, values: Float64Array, weight: Float64Array) -> _Factors:
        """Weighted least squares to values [P']: a constant for each slice, the terms of a field for each stack."""
        total = np.maximum(np.bincount(self.plane, weight, self.n_slices), 1e-30)

        def mean(of: Float64Array) -> Float64Array:
            return np.bincount(self.plane, weight * of, self.n_slices) / total

        mean_value, mean_terms = mean(values), np.column_stack([mean(term) for term in self.terms.T])
        coefficients = np.zeros((len(self.rows), N_TERMS))
        for n, rows in enumerate(self.rows):
            own, plane = weight[rows, None], self.plane[rows]
            terms, value = self.terms[rows] - mean_terms[plane], values[rows] - mean_value[plane]
            ridge = RIDGE * max(float(own.sum()), 1e-30) * np.eye(N_TERMS)
            coefficients[n] = np.linalg.solve(terms.T @ (own * terms) + ridge, terms.T @ (own[:, 0] * value))
        return _Factors(mean_value - (mean_terms * coefficients[self.stack]).sum(1), coefficients)

    def without_shared(self, factors: _Factors) -> _Factors:
        """The factors without the part that a shaded volume would explain as well."""
        shared = self.fitted(self.shading @ (self.shading.T @ (self.alike * self.of(factors))), self.alike)
        return _Factors(factors.log_gain - shared.log_gain, factors.coefficients - shared.coefficients)
