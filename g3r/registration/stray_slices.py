"""Search for slices that went astray, in the volume of all others.

Where the head moves between most slices, some slices end in a wrong place, from which no gradient and no neighbour
leads back. The weight of most of them falls to nothing, and what they saw is lost. Thick slices draw the volume after
them and are recognised by their low correlation alone. The volume of the others is good by then. So strays are tried in
many places of it, and motion in time decides between these as in the search for motion segments.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import DARK, DROPPED_WEIGHT
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.motion_segments import cheapest_path, estimate_interleave, time_orders, transition_penalties
from g3r.registration.pose_sampling import distinct, perturbed
from g3r.registration.similarity import (
    CORRELATION_AREA_MM2,
    SearchPixels,
    mean_square_residual,
    own_moments,
    student_cost,
)
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW

logger = logging.getLogger(__name__)

VOXEL_MM, PIXELS_OF_VOLUME = 2.0, 200_000
"""Voxel size and number of pixels of the volume in which strays are searched."""

N_FIRST = 10_000
"""Motions that are tried first, around those of all slices that fit."""

STEPS = ((12.0, 6.0), (6.0, 3.0), (3.0, 1.5), (1.5, 0.8))
"""Standard deviations of random rotations (degrees) and translations (mm), from step to step."""

N_KEPT = (20, 10, 5, 3)
"""Number of best motions that are kept for a slice after each step."""

N_EACH = 60
"""Random motions around each kept motion in the next step."""

MIN_SAMPLES = 10.0
"""Least number of independent samples in a slice that is searched: smaller slices fit in many places."""

MIN_GAIN = 5.0
"""Least fall of the cost (log odds) of a slice for another place to be taken: the best of so many random motions is
better than a single one by about the logarithm of their number."""

UNLIKE = 2.0
"""A slice is searched, too, if 1 minus its correlation with the volume is more than this times that of the upper
quartile. Of 32 heads (`fast`, by hand) 20 were in severe motion, most of them in slices of 4.4 and 5 mm: the share of
the brain more than 2 mm off fell in four of these (from 40 to 25, 27 to 13, 8 to 5 and 4 to 2 %), rose in two (from 11
to 15, 2 to 4), and changed by less than 1 %, or because of other changes, in all others."""

MAX_UNLIKE = 0.5
"""Largest share of the slices of a stack that may be unlike the volume. If more are, the whole stack fits less, and the
rest makes no volume in which they could be found. In a round of two stacks, 23 of 52 slices that were 0.13 mm off, most
of one stack, went to 0.5 mm off (`mild-64011-sta34` of docs/tradeoff.md, `accurate`)."""

UNREACHABLE = 1e9
"""Cost of any other motion for a slice that fits where it is."""


def find_strays(
    slices: Slices,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    ncc: NDArray[np.float64],
    rng: np.random.Generator,
) -> tuple[Slices, int]:
    """Better places for slices that have lost their weight or are `UNLIKE` the volume, and are not dark.

    Args:
        slices: K slices at their present poses.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        ncc: [K] correlation of the slices with the volume.
        rng: source of random motions.

    Returns:
        The slices, and how many were moved. The next weights decide whether they count.
    """
    pixels = SearchPixels.of(slices.with_pose(slices.header_pose))
    n_samples = pixels.area_mm2 / CORRELATION_AREA_MM2
    fits = weight >= DOWNWEIGHTED_BELOW
    if not fits.any():
        return slices, 0
    unlike = fits & (1 - ncc > UNLIKE * (1 - np.quantile(ncc[fits], 0.75)))
    _, stack = np.unique(slices.stack_id, return_inverse=True)
    unlike &= (np.bincount(stack, unlike) <= MAX_UNLIKE * np.bincount(stack, fits))[stack]
    astray = ((weight < DROPPED_WEIGHT) | unlike) & (gain > DARK * np.median(gain)) & (n_samples >= MIN_SAMPLES)
    fits &= ~astray
    if not astray.any() or not fits.any():
        return slices, 0
    volume, grid = _volume_of_others(slices, gain, np.where(astray, 0.0, weight))
    motion = slices.world_from_header()
    at_home = mean_square_residual(own_moments(pixels, volume, grid, motion))
    search = _Search(slices, volume, grid, noise=float(np.median(at_home[fits])) + 1e-12)
    known, n_found = motion.take(np.flatnonzero(fits)), 0
    for stack in np.unique(slices.stack_id[astray]):
        rows = np.flatnonzero(slices.stack_id == stack)
        new, moved = search.of_stack(rows, motion.take(rows), astray[rows], known, rng)
        motion = motion.with_rows(rows, new)
        n_found += moved
    return slices.with_motion(motion), n_found


class _Search:
    """Search for the slices of one stack in a volume of all slices that fit.

    Args:
        slices: of all stacks.
        volume: [I, J, K] of the slices that fit, zero outside the masks.
        grid: its grid.
        noise: mean square residual of a slice that fits.
    """

    def __init__(self, slices: Slices, volume: NDArray[np.float32], grid: VolumeGrid, *, noise: float) -> None:
        self.slices = slices
        self.volume, self.grid, self.noise = volume, grid, noise

    def by_header(self, rows: NDArray[np.int64]) -> SearchPixels:
        """Pixels of slices at their header poses."""
        own = self.slices.take(rows)
        return SearchPixels.of(own.with_pose(own.header_pose))

    def costs(self, rows: NDArray[np.int64], motion: RigidPose) -> NDArray[np.float64]:
        """Negative log likelihood [S, J] of slices under motions (`student_cost`)."""
        pixels = self.by_header(rows)
        residual = mean_square_residual(pixels.moments(self.volume, self.grid, motion)).T
        return student_cost(residual, self.noise, pixels.area_mm2)

    def of_stack(
        self,
        rows: NDArray[np.int64],
        motion: RigidPose,
        astray: NDArray[np.bool_],
        known: RigidPose,
        rng: np.random.Generator,
    ) -> tuple[RigidPose, int]:
        """Motions [K] of the slices of a stack, and how many of those astray were moved.

        Args:
            rows: [K] the slices.
            motion: [K] of them.
            astray: [K] which are searched.
            known: motions of slices that fit.
            rng: source of random motions.
        """
        # of this stack alone: headers may place stacks far apart, and turns about a far point move the head a long way
        center_mm = self.by_header(rows).center_mm
        index = self.slices.slice_index[rows]
        order = time_orders(index)[estimate_interleave(motion, index, center_mm)]
        wanted = np.flatnonzero(astray)
        found = distinct(known, center_mm)
        n_each = max(1, N_FIRST // len(found))
        for (rotation_deg, translation_mm), n_kept in zip(STEPS, N_KEPT, strict=True):
            tried = perturbed(found, center_mm, n_each, rotation_deg, translation_mm, rng)
            cost = self.costs(rows[wanted], tried)
            best = np.argpartition(cost, min(n_kept, len(tried)) - 1, axis=1)[:, :n_kept]
            found, n_each = tried.take(np.unique(best)), N_EACH
        # the present motions of all slices come first, then the places that were found
        candidate = RigidPose.concatenated([motion, found])
        cost = np.full((len(rows), len(candidate)), UNREACHABLE)
        cost[np.arange(len(rows)), np.arange(len(rows))] = 0.0
        cost[wanted] = self.costs(rows[wanted], candidate)
        path, _ = cheapest_path(cost[order], transition_penalties(candidate, center_mm))
        choice = np.empty(len(rows), np.int64)
        choice[order] = path
        gained = cost[wanted, wanted] - cost[wanted, choice[wanted]]
        moved = wanted[gained > MIN_GAIN]
        for k, gain in zip(wanted, gained, strict=True):
            logger.debug("slice %d: another place is cheaper by %.0f", rows[k], gain)
        return motion.with_rows(moved, candidate.take(choice[moved])), len(moved)


def _volume_of_others(
    slices: Slices, gain: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float32], VolumeGrid]:
    """A volume of slices that fit, zero outside the masks, and its grid."""
    grid = grid_around(slices, VOXEL_MM, margin_mm=20.0)
    index = thinned(slices.planes.n_pixels, PIXELS_OF_VOLUME)
    operator = VoxelOperator(slices.planes, grid, index, (1, 1, 3))
    value = np.where(slices.mask[index], slices.value[index], 0) / gain[operator.plane]
    counts = np.where(weight < DROPPED_WEIGHT, 0.0, weight)[operator.plane]
    volume = solve_volume(operator, value.astype(np.float32), counts.astype(np.float32), n_iterations=6, smoothness=0.1)
    return gaussian_filter(volume, 0.5), grid
