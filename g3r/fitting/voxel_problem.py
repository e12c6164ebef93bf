"""A volume on voxels that explains the pixels of a fit, held near another volume and kept smooth between edges.

    minimise over V:  sum_p w_p (A V - y)_p^2  +  r sum_v [ h (V - V_0)^2 + s (|grad V| + q |grad V|^2) ]_v

A is the voxel operator with the profiles of the fit through the plane; in plane it reads voxels trilinearly, which
blurs about as much as the profile does there. r is the mean coverage of a voxel. Total variation is solved as a
sequence of weighted squares (lagged diffusivity, Vogel and Oman 1996).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.acquisition.total_variation import diffusivity, divergence_of_gradient
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.best_gains import best_gains
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.slice_stage import SliceFit
from g3r.geometry import VolumeGrid

Float32Array = NDArray[np.float32]

FINE_VOXEL, TOO_FINE_VOXEL = 0.6, 0.5
"""Voxel over pixel size, twice. Below the first, voxels may lie between pixels that are read along their normals alone,
so pixels get nodes in plane as well. Below the second these leave holes, too, and the pixels are not used."""


QUIET = 0.03
"""Standard deviation of noise, in normalised intensities, up to which the settings hold as they are: a little more than
that of stacks with a signal-to-noise ratio of 20 (0.024), since detail that a volume lacks counts as noise, too.
In noisier slices total variation grows with the square of their noise, as in a MAP estimate, and the hold with the
noise itself, since V_0 is made from the same slices and noisier, too. With a ratio of 5 or 6 a hold that grows with
the square cost 0.2 to 0.8 dB, one that does not grow at all up to 0.6 dB (docs/method.md, "The correction on
voxels")."""


@dataclass(frozen=True, kw_only=True)
class VoxelProblemSettings:
    """Settings of the minimisation.

    Args:
        hold: h, pull towards V_0, relative to what slices measure in a voxel.
        total_variation: s.
        tip: change from voxel to voxel below which total variation is quadratic.
        n_rounds: number of solutions, each with the edges of the one before.
        n_iterations: conjugate-gradient steps of each.
        squares: q, against isolated voxels that stand out, which total variation lets stand.
    """

    hold: float
    total_variation: float
    tip: float
    n_rounds: int
    n_iterations: int
    squares: float = 0.0

    def for_noise(self, noise: float) -> Self:
        """The settings for slices with a standard deviation of noise, in normalised intensities, see `QUIET`."""
        by = max(1.0, noise / QUIET)
        return replace(self, hold=by * self.hold, total_variation=by**2 * self.total_variation)


def too_fine(voxel_mm: float, slices: Slices) -> bool:
    """Whether voxels are too small for the pixels of slices to determine each."""
    return voxel_mm / float(np.median(slices.planes.spacing_mm)) < TOO_FINE_VOXEL


@dataclass(frozen=True, kw_only=True)
class FitPixels:
    """P' pixels of a fit as the volume should show them.

    Attributes:
        slices: with profiles and poses.
        index: number of each pixel among all.
        plane: of each pixel.
        value: intensities without gain and field.
        weight: not negative.
    """

    slices: Slices
    index: NDArray[np.int64]
    plane: NDArray[np.integer]
    value: Float32Array
    weight: Float32Array

    @classmethod
    def of(cls, fit: SliceFit, slices: Slices, pixel_weight: Float32Array) -> FitPixels:
        """The masked pixels of slices of a fit, or of the same slices with other values or masks.

        Args:
            fit: its gains, fields and slice weights are used.
            slices: in the poses of the fit.
            pixel_weight: [P].
        """
        index, plane = slices.pixel_index, slices.pixel_plane
        value = slices.value[index] / fit.gain[plane]
        if fit.bias_field:
            value = value / np.exp(StackBiasField(fit.slices).log_field(np.array(fit.bias_field))[index])
        weight = pixel_weight[index] * fit.weight[plane]
        return cls(slices=slices, index=index, plane=plane, value=value.astype(np.float32), weight=weight.astype("f4"))

    def take(self, chosen: NDArray[np.bool_]) -> FitPixels:
        """The pixels at a mask [P']."""
        kept = {name: getattr(self, name)[chosen] for name in ("index", "plane", "value", "weight")}
        return replace(self, **kept)

    def operator(self, grid: VolumeGrid) -> VoxelOperator:
        """A for these pixels and a grid."""
        pixel_mm = float(np.median(self.slices.planes.spacing_mm))
        in_plane = 3 if float(grid.spacing_mm.min()) / pixel_mm < FINE_VOXEL else 1
        return VoxelOperator(self.slices.planes, grid, self.index, (in_plane, in_plane, 5))

    def error(self, volume: Float32Array, grid: VolumeGrid) -> float:
        """Root mean square error of what a volume [I, J, K] predicts, after a gain for each slice."""
        off = self._off(volume, grid)
        return float(np.sqrt((self.weight * off**2).sum() / max(float(self.weight.sum()), 1e-30)))

    def noise(self, volume: Float32Array, grid: VolumeGrid) -> float:
        """Robust standard deviation of these errors, in which edges that the volume shows too soft hardly count."""
        counts = self.weight > 0.5 * self.weight.max(initial=0)
        return robust_width(self._off(volume, grid)[counts]) if counts.any() else 0.0

    def _off(self, volume: Float32Array, grid: VolumeGrid) -> NDArray[np.float64]:
        predicted = self.operator(grid).forward(volume)
        gain = best_gains(self.weight, predicted, self.value, self.plane, len(self.slices), of_nothing=1)
        return gain[self.plane] * predicted - self.value


class VoxelProblem:
    """The minimisation for some pixels and a hold.

    Args:
        pixels: to be explained.
        grid: of the volumes.
        settings: hold, strength of total variation, and how long.

    Attributes:
        pixels_per_voxel: mean coverage of a voxel that pixels show, r.
    """

    def __init__(self, pixels: FitPixels, grid: VolumeGrid, settings: VoxelProblemSettings) -> None:
        self.pixels, self.grid, self.settings = pixels, grid, settings
        self.operator = pixels.operator(grid)
        seen = self.operator.adjoint(pixels.weight)
        typical = float(seen[seen > 0.1 * seen.max(initial=0)].mean()) if seen.any() else 1.0
        self.pixels_per_voxel = typical
        self.hold, self.strength = (np.float32(typical * one) for one in (settings.hold, settings.total_variation))

    def solved(self, volume: Float32Array) -> Float32Array:
        """V [I, J, K] for V_0 [I, J, K]."""
        target = self.operator.adjoint(self.pixels.weight * self.pixels.value) + self.hold * volume
        found = volume
        for _ in range(self.settings.n_rounds):
            found = self.solve(target, found, self.edges(found))
        return found

    def edges(self, volume: Float32Array) -> Float32Array:
        """Weights of total variation by the edges of a volume [I, J, K], for `solve`."""
        return diffusivity(volume, self.settings.tip) + np.float32(self.settings.squares)

    def cross_validation(self, found: Float32Array, probe: Float32Array) -> float:
        """Generalised cross-validation (Golub, Heath and Wahba, Technometrics 1979) of a solution.

        It estimates, up to a factor, the error for pixels that the solution was not made from: the root mean square
        error of its own pixels over 1 - t / n. Of n pixels, t could be explained whatever they show. t is the trace of
        the map from pixels to what is predicted for them, with the edges of the solution, by one random probe (Girard,
        Numerische Mathematik 1989).

        Args:
            found: V [I, J, K].
            probe: [P'] white noise.
        """
        target = self.operator.adjoint(np.sqrt(self.pixels.weight) * probe)
        edges, answer = self.edges(found), np.zeros_like(found)
        for _ in range(self.settings.n_rounds):
            answer = self.solve(target, answer, edges)
        weight = self.pixels.weight.astype(np.float64)
        n_pixels = weight.sum() ** 2 / max(float((weight**2).sum()), 1e-30)
        explained = float((target.astype(np.float64) * answer).sum()) / max(float(n_pixels), 1.0)
        return self.pixels.error(found, self.grid) / max(1 - explained, 1e-3)

    def solve(self, target: Float32Array, start: Float32Array, edges: Float32Array) -> Float32Array:
        """One solution of the normal equations with given weights of total variation.

        Args:
            target: [I, J, K] right-hand side.
            start: [I, J, K] where the iteration begins.
            edges: [I, J, K] of `edges`.
        """

        def normal(flat: NDArray[np.floating]) -> Float32Array:
            volume = flat.reshape(self.grid.shape).astype(np.float32)
            data = self.operator.adjoint(self.pixels.weight * self.operator.forward(volume).astype(np.float32))
            held = self.hold * volume + self.strength * divergence_of_gradient(volume, edges)
            return (data + held).ravel().astype(np.float32)

        system = LinearOperator((target.size, target.size), matvec=normal, dtype=np.float32)
        found, _ = cg(system, target.ravel(), x0=start.ravel(), maxiter=self.settings.n_iterations, rtol=1e-4)
        return np.asarray(found, np.float32).reshape(self.grid.shape)
