"""What slices still say of a volume that its Gaussians cannot show, as a correction of the volume on voxels.

    minimise over V:  sum_p w_p (A V - y)_p^2  +  r sum_v [ h (V - V_0)^2 + s |grad V| ]_v

V_0 is the mixture of Gaussians and V_prior, A the voxel operator with the profiles of the fit, y the pixels without
gains and fields, r the mean coverage of a voxel. Gaussians stand further apart than voxels: an edge between two of them
comes out too soft. The correction D = V - V_0 sharpens it as far as the slices ask for it against h and s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import LinearOperator, cg

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.acquisition.total_variation import diffusivity, divergence_of_gradient
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.fitting.bias_field import StackBiasField
from g3r.fitting.slice_stage import SliceFit
from g3r.geometry import VolumeGrid

Array = NDArray[np.float32]

FINE_VOXEL, TOO_FINE_VOXEL = 0.6, 0.5
"""Share of a pixel below which a voxel may lie between pixels that are read along their normals alone, so that they get
nodes in plane as well; and below which these leave holes, too, and nothing is corrected."""

QUIET = 0.03
"""Standard deviation of noise, in normalised intensities, up to which the settings hold as they are: a little more than
that of stacks with a signal-to-noise ratio of 20 (0.024), since what V_0 lacks in detail is counted, too. The word of
noisier slices counts less, by the square of it, as in a MAP estimate: with a ratio of 5 and two stacks of a simulated
subject an unchanged hold cost 0.6 dB against no correction."""

PROBE_SIGMA_MM, KEPT_SIGMA_MM = 0.4, 3.2
"""Width of the random change by which it is found how much of V_0 stays, and of the neighbourhoods in which answers are
compared (as in `uncertainty.prior_share`). Of wider changes less stays; of this one about as much as of V_prior - V_G,
or a little less: 0.51 and 0.63 of 0.53 and 0.69 in a simulated and a real subject."""


@dataclass(frozen=True, kw_only=True)
class VoxelCorrectionSettings:
    """How the volume is corrected.

    Args:
        hold: h, pull towards V_0, over what slices measure in a voxel.
        total_variation: s.
        tip: change from voxel to voxel, in normalised intensities, below which total variation is a square.
        n_rounds: solutions, each with the edges of the one before.
        n_iterations: conjugate-gradient steps of each.
    """

    hold: float = 0.6
    total_variation: float = 0.015
    tip: float = 0.02
    n_rounds: int = 2
    n_iterations: int = 8

    def for_noise(self, noise: float) -> VoxelCorrectionSettings:
        """The settings for slices with a standard deviation of noise, in normalised intensities, see `QUIET`."""
        by = max(1.0, noise / QUIET) ** 2
        return replace(self, hold=by * self.hold, total_variation=by * self.total_variation)


@dataclass(frozen=True, kw_only=True)
class VoxelCorrectionRecord:
    """What was corrected.

    Attributes:
        hold: that was taken, by the noise of the slices.
        size: root mean square of the correction in the brain, in normalised intensities.
    """

    hold: float
    size: float


@dataclass(frozen=True, kw_only=True)
class VoxelCorrection:
    """The correction of a volume.

    Attributes:
        values: D [I, J, K], to be added to V_0. Rounded to float16, as which it is kept.
        kept: share [I, J, K] of a small change of V_0 that would stay in V.
        record: for run.json.
    """

    values: NDArray[np.float16]
    kept: Array
    record: VoxelCorrectionRecord


def too_fine(grid: VolumeGrid, slices: Slices) -> bool:
    """Whether the voxels of a grid are too small for the pixels of slices to correct them."""
    return _voxel_over_pixel(grid, slices) < TOO_FINE_VOXEL


def _voxel_over_pixel(grid: VolumeGrid, slices: Slices) -> float:
    return float(grid.spacing_mm.min()) / float(np.median(slices.planes.spacing_mm))


def correct_on_voxels(
    volume: Array,
    fit: SliceFit,
    pixel_weight: Array,
    grid: VolumeGrid,
    reach: Array,
    settings: VoxelCorrectionSettings,
    rng: np.random.Generator,
) -> VoxelCorrection:
    """The correction of a volume by the slices of its fit.

    Args:
        volume: V_0 [I, J, K].
        fit: slices with profiles, poses, gains and fields.
        pixel_weight: [P] of the fit.
        grid: of the volume.
        reach: [I, J, K] from 0 to 1, how much of the correction counts: 0 where there are no Gaussians or slices.
        settings: how strong.
        rng: draws the change by which `kept` is found.
    """
    whole = _Pixels.of(fit, pixel_weight)
    # how far slices of a single stack are off counts as noise: no other stack checks their poses
    chosen = settings.for_noise((whole.error if fit.slices.n_stacks == 1 else whole.noise)(volume, grid))
    problem = _Problem(whole, grid, chosen)
    found = problem.solved(volume)
    values = ((found - volume) * reach).astype(np.float16)
    inside = reach > 0
    size = float(np.sqrt((values[inside].astype(np.float64) ** 2).mean())) if inside.any() else 0.0
    kept = 1 - reach * (1 - problem.kept(found, rng))
    return VoxelCorrection(
        values=values, kept=kept, record=VoxelCorrectionRecord(hold=round(chosen.hold, 3), size=round(size, 5))
    )


@dataclass(frozen=True, kw_only=True)
class _Pixels:
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
    value: Array
    weight: Array

    @classmethod
    def of(cls, fit: SliceFit, pixel_weight: Array) -> _Pixels:
        slices, index, plane = fit.slices, fit.slices.pixel_index, fit.slices.pixel_plane
        value = slices.value[index] / fit.gain[plane]
        if fit.bias_field:
            value = value / np.exp(StackBiasField(slices).log_field(np.array(fit.bias_field))[index])
        weight = pixel_weight[index] * fit.weight[plane]
        return cls(slices=slices, index=index, plane=plane, value=value.astype(np.float32), weight=weight.astype("f4"))

    def operator(self, grid: VolumeGrid) -> VoxelOperator:
        in_plane = 3 if _voxel_over_pixel(grid, self.slices) < FINE_VOXEL else 1
        return VoxelOperator(self.slices.planes, grid, self.index, (in_plane, in_plane, 5))

    def error(self, volume: Array, grid: VolumeGrid) -> float:
        """Root mean square error of what a volume [I, J, K] predicts, after a gain for each slice."""
        off = self._off(volume, grid)
        return float(np.sqrt((self.weight * off**2).sum() / max(float(self.weight.sum()), 1e-30)))

    def noise(self, volume: Array, grid: VolumeGrid) -> float:
        """Standard deviation of the same from its median, so that edges that the volume shows too soft hardly count."""
        counts = self.weight > 0.5 * self.weight.max(initial=0)
        return robust_width(self._off(volume, grid)[counts]) if counts.any() else 0.0

    def _off(self, volume: Array, grid: VolumeGrid) -> NDArray[np.float64]:
        predicted, n = self.operator(grid).forward(volume), len(self.slices)
        across, own = (np.bincount(self.plane, self.weight * predicted * one, n) for one in (self.value, predicted))
        gain = np.divide(across, own, out=np.ones(n), where=own > 0)
        return gain[self.plane] * predicted - self.value


class _Problem:
    """The minimisation for some pixels and a hold.

    Args:
        pixels: that are explained.
        grid: of the volumes.
        settings: hold, strength of total variation, and how long.
    """

    def __init__(self, pixels: _Pixels, grid: VolumeGrid, settings: VoxelCorrectionSettings) -> None:
        self.pixels, self.grid, self.settings = pixels, grid, settings
        self.operator = pixels.operator(grid)
        seen = self.operator.adjoint(pixels.weight)
        typical = float(seen[seen > 0.1 * seen.max(initial=0)].mean()) if seen.any() else 1.0
        self.hold, self.strength = (np.float32(typical * one) for one in (settings.hold, settings.total_variation))

    def solved(self, volume: Array) -> Array:
        """V of V_0."""
        target = self.operator.adjoint(self.pixels.weight * self.pixels.value) + self.hold * volume
        found = volume
        for _ in range(self.settings.n_rounds):
            found = self._solve(target, found, diffusivity(found, self.settings.tip))
        return found

    def kept(self, found: Array, rng: np.random.Generator) -> Array:
        """Share [I, J, K] of a small change of V_0 that stays in V, with the edges of V."""
        change = gaussian_filter(rng.standard_normal(self.grid.shape), PROBE_SIGMA_MM / self.grid.spacing_mm)
        change = (change / change.std()).astype(np.float32)
        left = self._solve(self.hold * change, change, diffusivity(found, self.settings.tip))
        width = KEPT_SIGMA_MM / self.grid.spacing_mm
        together, own = (gaussian_filter(one * change, width) for one in (left, change))
        return np.clip(together / np.maximum(own, 1e-6), 0, 1).astype(np.float32)

    def _solve(self, target: Array, start: Array, edges: Array) -> Array:
        def normal(flat: NDArray[np.floating]) -> Array:
            volume = flat.reshape(self.grid.shape).astype(np.float32)
            data = self.operator.adjoint(self.pixels.weight * self.operator.forward(volume).astype(np.float32))
            held = self.hold * volume + self.strength * divergence_of_gradient(volume, edges)
            return (data + held).ravel().astype(np.float32)

        system = LinearOperator((target.size, target.size), matvec=normal, dtype=np.float32)
        found, _ = cg(system, target.ravel(), x0=start.ravel(), maxiter=self.settings.n_iterations, rtol=1e-4)
        return np.asarray(found, np.float32).reshape(self.grid.shape)
