"""Correction of a volume on voxels, by detail in the slices that its Gaussians cannot show.

    minimise over V:  sum_p w_p (A V - y)_p^2  +  r sum_v [ h (V - V_0)^2 + s |grad V| ]_v

V_0 is the mixture of Gaussians and V_prior, A the voxel operator (`fitting.voxel_problem`), y the pixels without gains
and fields, r the mean coverage of a voxel. Gaussians lie further apart than voxels, so an edge between two of them is
too soft. The correction D = V - V_0 sharpens it as far as the slices require it against h and s.

How well V_0 shows a head differs: h is low where generalised cross-validation finds that V_0 is in the way. Total
variation then has to tell detail from noise alone, so its edges are found in more rounds, and it is sharper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.planes import Slices
from g3r.fitting.slice_stage import SliceFit
from g3r.fitting.voxel_problem import FitPixels, Float32Array, VoxelProblem, VoxelProblemSettings
from g3r.geometry import VolumeGrid

PROBE_SIZE = np.float32(0.03)
"""Standard deviation of the random change that measures how much of V_0 stays, in normalised intensities."""

PROBE_SIGMA_MM, KEPT_SIGMA_MM = 0.4, 3.2
"""Width of that change, and of the neighbourhoods in which responses are
compared (as in `uncertainty.prior_share`). Of wider changes less stays; of this one about as much as of V_prior - V_G
(V_G: the Gaussians alone), or a little less: 0.51 and 0.63 of 0.53 and 0.69 in a simulated and a real subject."""


@dataclass(frozen=True, kw_only=True)
class VoxelCorrectionSettings(VoxelProblemSettings):
    """Settings of the correction of a single fit; intensities are normalised.

    Args:
        loosens: whether `LOOSE` is used instead where cross-validation prefers less hold. Only from three stacks on,
            since it takes errors of poses for detail.
    """

    hold: float = 0.6
    total_variation: float = 0.015
    tip: float = 0.02
    n_rounds: int = 2
    n_iterations: int = 8
    loosens: bool = True

    def for_mean(self) -> VoxelCorrectionSettings:
        """The settings for the mean of several fits."""
        hold, strength = MEAN_HOLD * self.hold, MEAN_TOTAL_VARIATION * self.total_variation
        return replace(self, hold=hold, total_variation=strength)


TIGHT = VoxelCorrectionSettings()
LESS_HELD = replace(TIGHT, hold=0.15)
"""The two that cross-validation compares, on V_0 from one fit. It cannot choose total variation, of which it prefers
less in all heads, and it hardly tells against the mean of several fits, whose freedom it does not know."""

LOOSE = replace(TIGHT, hold=0.06, total_variation=0.011, tip=0.005, n_rounds=4)
"""Used where less hold is better. On four phantoms, each in moderate and in mild motion, it has 0.01 to 0.20 dB more
than `LESS_HELD`, and 0.70 to 0.75 of its LPIPS."""

MEAN_HOLD, MEAN_TOTAL_VARIATION = 2.5, 2.0
"""Factors of hold and total variation for a mean of several fits, which leaves less to correct than one fit."""

CLEARLY = 0.997
"""`LOOSE` is taken if `LESS_HELD` has at most this share of the error of `TIGHT`. Phantoms, which gain, have 0.987 to
0.993, heads of atlases, which would lose, 0.999 to 1.030, and with much noise up to 1.051."""

DARK_BESIDE = 0.3
"""Median intensity beside the brain over that in it, above which cross-validation is not asked. It is at most 0.15 in
simulated heads, 0.64 to 1.4 in surroundings, and 0.80 in three real stacks. There masks reach a rim beyond the brain,
which is sharper than V_0: five cases had 0.940 to 0.992, and the two that were scored lost 1.9 dB inside the brain by
`LOOSE`. Without the pixels in the outer 4 mm four of them had 1.007 to 1.022, but the fifth still 0.992."""

FINEST_ACQUIRED_MM = 0.7
"""Smaller pixels of a fetal head are interpolated. Their noise is not white, as cross-validation takes it to be: it
found 0.95 to 0.98 where less hold made things worse (synthetic slices, zero-filled to half of the pixel size)."""

ENOUGH_PIXELS = 0.4
"""Pixels in a voxel, on average, from which on cross-validation is asked. Three stacks of phantoms that gain have 1.0
(0.8 x 0.8 x 2.2 mm); three of a head with about 0.2 (1.3 x 1.3 x 4 mm) had 0.993, and `LOOSE` lost 0.9 dB: where voxels
are many more than pixels, total variation decides instead of them."""

ENOUGH_STACKS = 3
"""Two stacks may be wrong together: slices 0.25 mm off gave 0.983, and a loss of 0.27 dB."""


@dataclass(frozen=True, kw_only=True)
class VoxelCorrectionRecord:
    """Record of the correction.

    Attributes:
        hold: the hold in use, adapted to the noise of the slices.
        loose_error: error of predictions with `LESS_HELD` over that with `TIGHT`, by cross-validation; None if not
            asked.
        size: root mean square of the correction in the brain, in normalised intensities.
    """

    hold: float
    loose_error: float | None
    size: float


@dataclass(frozen=True, kw_only=True)
class VoxelCorrection:
    """The correction of a volume.

    Attributes:
        values: D [I, J, K], to be added to V_0. Rounded to float16, in which it is stored.
        kept: share [I, J, K] of a small change of V_0 that would stay in V.
        record: for run.json.
    """

    values: NDArray[np.float16]
    kept: Float32Array
    record: VoxelCorrectionRecord


def correct_on_voxels(
    volume: Float32Array,
    of_one_fit: Float32Array,
    fit: SliceFit,
    pixel_weight: Float32Array,
    grid: VolumeGrid,
    reach: Float32Array,
    settings: VoxelCorrectionSettings,
    rng: np.random.Generator,
) -> VoxelCorrection:
    """The correction of a volume by the slices of its fit.

    Args:
        volume: V_0 [I, J, K].
        of_one_fit: [I, J, K] V_0 with the Gaussians of the first fit alone; the same unless it is a mean of several.
        fit: slices with profiles, poses, gains and fields.
        pixel_weight: [P] of the fit.
        grid: of the volume.
        reach: [I, J, K] from 0 to 1, how much of the correction counts: 0 where there are no Gaussians or slices.
        settings: hold, strength of total variation, and numbers of steps.
        rng: draws the change that measures `kept`, and the probe of cross-validation.
    """
    whole = FitPixels.of(fit, fit.slices, pixel_weight)
    loose_error: float | None = None
    tight: Float32Array | None = None
    if fit.slices.n_stacks == 1:
        # pose errors of a single stack count as noise: no other stack checks its poses
        noise = whole.error(volume, grid)
    else:
        noise = whole.noise(volume, grid)
        if settings.loosens and _can_compare(whole, grid):
            loose_error, tight = _compared(whole, grid, of_one_fit, noise, rng)
    asked = settings if of_one_fit is volume else settings.for_mean()
    if loose_error is not None and loose_error <= CLEARLY:
        asked = LOOSE
    problem = VoxelProblem(whole, grid, asked.for_noise(noise))
    found = tight if tight is not None and asked == TIGHT else problem.solved(volume)
    values = ((found - volume) * reach).astype(np.float16)
    inside = reach > 0
    size = float(np.sqrt((values[inside].astype(np.float64) ** 2).mean())) if inside.any() else 0.0
    kept = 1 - reach * (1 - _kept(problem, volume, found, rng))
    record = VoxelCorrectionRecord(
        hold=round(problem.settings.hold, 3),
        loose_error=None if loose_error is None else round(loose_error, 4),
        size=round(size, 5),
    )
    return VoxelCorrection(values=values, kept=kept, record=record)


def _can_compare(pixels: FitPixels, grid: VolumeGrid) -> bool:
    """Whether stacks and pixels are enough for cross-validation, acquired as they are, and dark beside the brain."""
    slices = pixels.slices
    if slices.n_stacks < ENOUGH_STACKS or float(np.median(slices.planes.spacing_mm)) < FINEST_ACQUIRED_MM:
        return False
    if not _is_dark_beside(slices):
        return False
    return VoxelProblem(pixels, grid, TIGHT).pixels_per_voxel >= ENOUGH_PIXELS


def _is_dark_beside(slices: Slices) -> bool:
    """Whether images are dark beside the brain, as simulated and brain-extracted ones are."""
    beside, inside = slices.value[~slices.mask], slices.value[slices.mask]
    return not beside.size or float(np.median(beside)) <= DARK_BESIDE * float(np.median(inside))


def _compared(
    pixels: FitPixels, grid: VolumeGrid, volume: Float32Array, noise: float, rng: np.random.Generator
) -> tuple[float, Float32Array]:
    """Error of predictions with `LESS_HELD` over that with `TIGHT`, by cross-validation, and the volume of `TIGHT`."""
    probe = rng.standard_normal(len(pixels.value)).astype(np.float32)
    errors = []
    for settings in (LESS_HELD, TIGHT):
        problem = VoxelProblem(pixels, grid, settings.for_noise(noise))
        found = problem.solved(volume)
        errors.append(problem.cross_validation(found, probe))
    return errors[0] / max(errors[1], 1e-30), found


def _kept(problem: VoxelProblem, volume: Float32Array, found: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Share [I, J, K] of a small change of V_0 that stays in V, edges that follow the change included."""
    grid = problem.grid
    change = gaussian_filter(rng.standard_normal(grid.shape), PROBE_SIGMA_MM / grid.spacing_mm)
    change = (change / change.std()).astype(np.float32)
    left = (problem.solved(volume + PROBE_SIZE * change) - found) / PROBE_SIZE
    width = KEPT_SIGMA_MM / grid.spacing_mm
    together, own = (gaussian_filter(one * change, width) for one in (left, change))
    return np.clip(together / np.maximum(own, 1e-6), 0, 1).astype(np.float32)
