"""Held-out scores: how well a volume made of the other stacks predicts each stack in given poses."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.atlas_template import PlacedHead
from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import spacing_of_each_mm
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.motion_segments import changes_in_time, estimate_interleave, transition_penalty
from g3r.registration.similarity import (
    CORRELATION_AREA_MM2,
    StackSamples,
    correlation,
    mean_square_residual,
    own_moments,
)
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW
from g3r.registration.unseen import coverage_share, filled_with_head, grid_with_head

logger = logging.getLogger(__name__)

HELD_OUT_VOXEL_MM = 3.2

FINE_VOXEL_MM, FINE_PIXELS_OF_VOLUME = 1.6, 200_000
"""Voxel size and number of pixels of the finer comparison, see `fine_held_out_correlations`."""

MIN_SHARE = 0.8
"""Share of the slices of a stack that must not be down-weighted for the others to be left out of its agreement. This
raised the agreement of a phantom in place with 12 % of strays from 0.65 to 0.75. Of 17 simulated subjects, most in
severe motion, stacks with many slices out of place rose by 0.03 at most, except one from 0.63 to 0.71, in which 23 %
were off by more than 2 mm; one with a third of strays, half of which were off, would have risen from 0.55 to 0.71."""

THIN_VARIANCE = 1 / 6
"""Variance of a slice's profile, over the square of a voxel, below which the profile is ignored: linear interpolation
between voxels blurs as much."""

PIXELS_OF_VOLUME = 100_000
"""A volume of the search is made of at most this many pixels."""


def volume_without(
    slices: Slices, stack: int, spacing_mm: float, fill: PlacedHead | None = None
) -> tuple[NDArray[np.float32], VolumeGrid]:
    """A volume from all slices except those of one stack, zero outside the masks; and its grid.

    With the stack in it, slices would register to their own blur.

    Args:
        slices: all slices at their present poses.
        stack: the one to hold out.
        spacing_mm: voxel size.
        fill: template for voxels that no other stack saw; these are zero without it.
    """
    others = _of_others(slices, stack, spacing_mm, fill)
    volume = others.volume(n_iterations=6)
    if fill is not None:
        volume = filled_with_head(volume, others.grid, others.coverage(), fill)
    return gaussian_filter(volume, 0.5), others.grid


def coverage_without(slices: Slices, stack: int, spacing_mm: float) -> tuple[NDArray[np.float32], VolumeGrid]:
    """How far all slices except those of one stack saw each voxel, from 0 (unseen) to 1; and the grid.

    Args:
        slices: all slices at their present poses.
        stack: the one to hold out.
        spacing_mm: voxel size.
    """
    others = _of_others(slices, stack, spacing_mm, None)
    return coverage_share(others.coverage()), others.grid


@dataclass(frozen=True)
class _Others:
    """Some pixels of all other stacks, pixels outside the masks included.

    Args:
        operator: from volumes to the P pixels.
        value: [P] of the pixels, 0 outside the masks.
        amount: [P] volume that a pixel stands for (area times slice spacing, for all that were left out) in voxels.
    """

    operator: VoxelOperator
    value: NDArray[np.float32]
    amount: NDArray[np.float32]

    @property
    def grid(self) -> VolumeGrid:
        """Grid of the volumes."""
        return self.operator.grid

    def volume(self, n_iterations: int) -> NDArray[np.float32]:
        """The volume [I, J, K] by least squares."""
        weight = np.ones(len(self.value), np.float32)
        return solve_volume(self.operator, self.value, weight, n_iterations=n_iterations, smoothness=0.1)

    def coverage(self) -> NDArray[np.float32]:
        """Coverage [I, J, K]: about 1 where one stack looked."""
        return self.operator.adjoint(self.amount).astype(np.float32)


def _of_others(
    slices: Slices, stack: int, spacing_mm: float, fill: PlacedHead | None, n_pixels: int = PIXELS_OF_VOLUME
) -> _Others:
    """The pixels of all stacks but one: all, or `n_pixels` of them."""
    others = slices.take(slices.stack_id != stack)
    grid = grid_around(others, spacing_mm, margin_mm=20.0)
    if fill is not None:
        grid = grid_with_head(grid, fill)
    index = thinned(others.planes.n_pixels, n_pixels)
    is_thin = float(others.planes.psf_var_mm2[:, 2].max()) < THIN_VARIANCE * spacing_mm**2
    operator = VoxelOperator(others.planes, grid, index, (1, 1, 1 if is_thin else 3))
    value = np.where(others.mask[index], others.value[index], 0).astype(np.float32)
    pixel_mm3 = others.planes.pixel_area_mm2 * spacing_of_each_mm(others)
    amount = pixel_mm3 / grid.voxel_volume_mm3 * (others.planes.n_pixels / max(len(index), 1))
    return _Others(operator, value, amount[operator.plane].astype(np.float32))


LEAST_ENERGY = 0.01
"""Least mean square of a slice over that of its stack. Thinned pixels of a small slice may all lie outside its mask;
the faint values that other stacks show there would then be compared with zero, and that slice would decide for all."""


@dataclass(frozen=True)
class Prediction:
    """Fit of the slices of a stack to a volume that was made without it.

    Args:
        cost: of the slices (n log residual, the noise being unknown) plus the transition penalty of their
            motions; comparable between placements of the same stack.
        moments: [K, 6] of the slices, see `SearchPixels.moments`.
    """

    cost: float
    moments: NDArray[np.float64]

    @property
    def correlation(self) -> float:
        """Correlation over all pixels, outline included."""
        return float(correlation(self.moments.sum(0)))

    def agreement(self, weight: NDArray[np.float64]) -> float:
        """Correlation without the down-weighted slices, if these are few; else over all slices.

        Slices that went astray in a stack that is in place count for nothing in the volume, and are reported
        separately (`StackQuality.downweighted_share`).

        Args:
            weight: [K] slice weights.
        """
        counts = weight >= DOWNWEIGHTED_BELOW
        return float(correlation(self.moments[counts].sum(0))) if counts.mean() >= MIN_SHARE else self.correlation


def predict(
    sample: StackSamples, motion: RigidPose, volume: NDArray[np.float32], grid: VolumeGrid, interleave: int
) -> Prediction:
    """Compare a stack with a volume that was made without it.

    Args:
        sample: the stack.
        motion: [K] world from header.
        volume: [I, J, K].
        grid: its grid.
        interleave: acquisition order of the stack.
    """
    moments = own_moments(sample.pixels, volume, grid, motion)
    energy = moments[:, 3] / moments[:, 0]
    least = LEAST_ENERGY * moments[:, 3].sum() / moments[:, 0].sum() + 1e-30
    relative = mean_square_residual(moments) / np.maximum(energy, least)
    fit = (sample.pixels.area_mm2 / CORRELATION_AREA_MM2) @ np.log(relative + 1e-4)
    moves = changes_in_time(motion, sample.slice_index, sample.pixels.center_mm, interleave)
    return Prediction(float(fit) + transition_penalty(moves), moments)


@dataclass(frozen=True)
class HeldOutScore:
    """How well each stack is predicted by the others: one `Prediction` for each."""

    prediction: list[Prediction]

    @property
    def cost(self) -> float:
        """Sum over the stacks."""
        return sum(p.cost for p in self.prediction)

    @property
    def correlations(self) -> list[float]:
        """Correlation of each stack with the volume of the others."""
        return [p.correlation for p in self.prediction]

    def agreements(self, samples: list[StackSamples], weight: NDArray[np.float64]) -> list[float]:
        """`Prediction.agreement` of each stack, from the weights [K] of all slices."""
        return [p.agreement(weight[sample.rows]) for p, sample in zip(self.prediction, samples, strict=True)]


def held_out_score(
    slices: Slices, samples: list[StackSamples], motion: RigidPose, fill: PlacedHead | None = None
) -> HeldOutScore:
    """Hold out each stack in turn and compare it with the volume of the others.

    Args:
        slices: of two or more stacks.
        samples: the thinned pixels of each stack.
        motion: [K] world from header of all slices.
        fill: see `volume_without`.
    """
    posed = slices.with_motion(motion)
    predictions = []
    for sample in samples:
        volume, grid = volume_without(posed, sample.stack, HELD_OUT_VOXEL_MM, fill)
        own = motion.take(sample.rows)
        interleave = estimate_interleave(own, sample.slice_index, sample.pixels.center_mm)
        predictions.append(predict(sample, own, volume, grid, interleave))
    return HeldOutScore(predictions)


def fine_volume_without(slices: Slices, stack: int) -> tuple[NDArray[np.float32], NDArray[np.float32], VolumeGrid]:
    """A volume from all slices except those of one stack, finer than in the search; its `coverage_share`; the grid.

    Args:
        slices: all slices at their present poses, gains divided out.
        stack: the one to hold out.
    """
    others = _of_others(slices, stack, FINE_VOXEL_MM, None, FINE_PIXELS_OF_VOLUME)
    return others.volume(n_iterations=8), coverage_share(others.coverage()), others.grid


def fine_held_out_correlations(slices: Slices, gain: NDArray[np.float64]) -> list[float]:
    """Correlation of each stack's masked pixels with the volume of the others, fine enough to tell poses 0.3 mm apart.

    Only pixels that others saw count: their volume is zero elsewhere, so that poses which make the holes smaller would
    seem better.

    Args:
        slices: of two or more stacks, at their present poses.
        gain: [K] intensity factors.

    Returns:
        The correlation of each stack; 0 where the others saw nothing of it.
    """
    evened = slices.without_gain(gain)
    found = []
    for stack in np.unique(slices.stack_id):
        volume, share, grid = fine_volume_without(evened, stack)
        own = evened.take(evened.stack_id == stack)
        index = own.pixel_index[thinned(len(own.pixel_index), FINE_PIXELS_OF_VOLUME)]
        sampling = VoxelOperator(own.planes, grid, index, (1, 1, 5))
        seen = sampling.forward(share) > 0.5
        predicted, given = sampling.forward(volume)[seen], own.value[index[seen]]
        varies = seen.sum() > 1 and predicted.std() > 0 and given.std() > 0
        found.append(float(np.corrcoef(predicted, given)[0, 1]) if varies else 0.0)
    return found


def held_out_scores(
    slices: Slices,
    samples: list[StackSamples],
    initialisations: Mapping[str, RigidPose],
    fill: PlacedHead | None = None,
) -> dict[str, HeldOutScore]:
    """The scores of several initialisations.

    Args:
        slices: of two or more stacks.
        samples: the thinned pixels of each stack.
        initialisations: motions [K] (world from header) by name.
        fill: see `volume_without`.
    """
    scores = {name: held_out_score(slices, samples, motion, fill) for name, motion in initialisations.items()}
    for name, score in scores.items():
        correlations = " ".join(f"{one:.2f}" for one in score.correlations)
        logger.info("%s: held-out cost %.0f, correlation %s", name, score.cost, correlations)
    return scores
