"""Handedness of stacks: whether each shows the head as the others do, or its mirror image.

Slices that are stored in reverse order, or a header that swaps two sides, mirror the head. Heads are nearly symmetric,
so registration finds a place for the mirrored stack, and no other check notices: the volume mixes left and right. The
part of the head that changes its sign at the mid-sagittal plane reveals it. It is estimated as the difference of a
volume of the other stacks and its mirror image.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.held_out import fine_volume_without
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.similarity import SearchPixels, random_climb
from g3r.registration.slice_registration import register_slices
from g3r.registration.thresholds import LEAST_SHARE, MIRROR_SUSPECTED_BELOW, MIRRORED_BELOW, STANDS_APART, STANDS_OUT

logger = logging.getLogger(__name__)

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
"""Swaps left and right in the atlas frame."""

ROUNDS = ((5.0, 2.0), (2.5, 1.0), (1.2, 0.5), (0.6, 0.3))
"""Random rotations (degrees) and translations (mm) of a stack in the mirrored volume, round by round."""

N_CANDIDATES, PIXELS_PER_SLICE, MIN_PIXELS, MAX_PIXELS = 300, 200, 1_000, 60_000

N_STEPS = 5
"""Gauss-Newton steps of each slice of a suspected stack, in the volume and in its mirror image."""

SEEN_SHARE = 0.5
"""Coverage by the other stacks, over the usual one, that a pixel needs in the volume and in the mirror image."""

MIN_CORRELATION = 0.5
"""Correlation with the symmetric part of the volume below which a stack shows something else and cannot be judged."""


@dataclass(frozen=True)
class Asymmetry:
    """Correlation of a stack with the antisymmetric part of the head, as the other stacks show it.

    Args:
        correlation: of its pixels with the antisymmetric part of the head.
        error: its standard error.
        share: of the antisymmetric part as the others show it, how much the stack shows, too: 1 if both are the same
            and without noise, -1 for a mirror image, 0 if that part is none of the head's.
    """

    correlation: float
    error: float
    share: float

    @property
    def highest(self) -> float:
        """Upper bound of the correlation: one standard error more."""
        return self.correlation + self.error


def handedness(slices: Slices, gain: NDArray[np.float64], seed: int = 0) -> list[float | None]:
    """Handedness of each stack: whether it shows the asymmetry of the head as the others do.

    Args:
        slices: of two or more stacks, in the atlas frame (`Orientation`).
        gain: [K] intensity factors.
        seed: of the search in the mirrored volume.

    Returns:
        For each stack the correlation of its masked pixels with the antisymmetric part of the head, after the symmetric
        part was taken out of both, plus its standard error: above zero for the same head, near zero for a symmetric
        one, and below `thresholds.MIRRORED_BELOW` for a mirror image. None where it is unknown. One is called a mirror
        image only if the others show that the head is asymmetric (`_stands_out`). Two stacks cannot tell: they are
        registered so that what is not symmetric agrees, too. Of 13 sets of two with one in reverse order none was below
        the limit, of 11 sound ones 3 were (`fast`, by hand), so nothing is said of them.
    """
    if slices.n_stacks < 3:
        return [None] * slices.n_stacks
    asymmetry = _of_all(slices.without_gain(gain), np.random.default_rng(seed))
    found = [None if one is None else one.highest for one in asymmetry.values()]
    logger.info("handedness: %s", " ".join("unknown" if one is None else f"{one:.2f}" for one in found))
    return found


def _of_all(slices: Slices, rng: np.random.Generator) -> dict[int, Asymmetry | None]:
    """Asymmetry by stack number; if one may be mirrored, the others are measured again without it."""
    stacks = np.unique(slices.stack_id).tolist()
    found = {stack: _of_stack(slices, stack, rng) for stack in stacks}
    low = {stack: one for stack, one in found.items() if one is not None and one.highest < MIRRORED_BELOW}
    if len(stacks) > 2 and low:
        lowest = min(low, key=lambda stack: low[stack].highest)
        others = _of_all(slices.take(slices.stack_id != lowest), rng)
        if _stands_out(low[lowest], list(others.values())):
            return {**found, **others}
        found |= dict.fromkeys(low)
    return found


def _stands_out(one: Asymmetry, others: Sequence[Asymmetry | None]) -> bool:
    """Whether all other stacks, measured without this one, show an asymmetric head, and this one shows it mirrored."""
    known = [other for other in others if other is not None]
    if len(known) < len(others):
        return False
    usual = mean(other.correlation for other in known)
    error = sum(other.error**2 for other in known) ** 0.5 / len(known)
    has_sides = all(other.share > LEAST_SHARE for other in known)
    below_zero = one.correlation < -STANDS_OUT * one.error
    return has_sides and below_zero and one.correlation < usual - STANDS_APART * float(np.hypot(one.error, error))


def _of_stack(slices: Slices, stack: int, rng: np.random.Generator) -> Asymmetry | None:
    volume, share, grid = fine_volume_without(slices, stack)
    own = slices.take(slices.stack_id == stack)
    mirrored = VolumeGrid(grid.shape, MIRROR @ grid.affine)
    moved = _moved_as_one(own, volume, mirrored, rng)
    here = SampledSlices(own, volume, grid, n_pixels=MAX_PIXELS)
    there = SampledSlices(moved, volume, mirrored, n_pixels=MAX_PIXELS)
    # where the others saw one side alone, the difference is that side, and the stack resembles it
    seen = np.minimum(here.operator.forward(share), there.operator.forward(share)) > SEEN_SHARE
    value, plane = here.value[seen], here.operator.plane[seen]
    first = antisymmetric_correlation(
        value, here.operator.forward(volume)[seen], there.operator.forward(volume)[seen], plane
    )
    if first is None or first.highest >= MIRROR_SUSPECTED_BELOW:
        return first
    return antisymmetric_correlation(value, _registered(here, own)[seen], _registered(there, moved)[seen], plane)


def _moved_as_one(own: Slices, volume: NDArray[np.float32], grid: VolumeGrid, rng: np.random.Generator) -> Slices:
    """The slices of a stack after the one rigid motion that fits them best to a volume."""
    pixels = SearchPixels.of(own, PIXELS_PER_SLICE)
    motion, _ = random_climb(pixels, volume, grid, RigidPose.identity(1), ROUNDS, N_CANDIDATES, rng)
    return own.with_pose(motion.take(np.zeros(len(own), int)) @ own.planes.pose)


def _registered(model: SampledSlices, slices: Slices) -> NDArray[np.float32]:
    """Pixels as a volume predicts them after each slice was registered to it."""
    gain = np.ones(len(slices))
    width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
    placed, gain, _ = register_slices(model, slices, gain, n_steps=N_STEPS, width=width)
    operator: VoxelOperator = model.operator
    operator.move(placed.planes)
    return (operator.forward(model.volume) * gain[operator.plane]).astype(np.float32)


def antisymmetric_correlation(
    value: NDArray[np.float32], here: NDArray[np.float32], mirrored: NDArray[np.float32], plane: NDArray[np.int64]
) -> Asymmetry | None:
    """Correlation of pixels with here - mirrored, after here + mirrored and a constant were taken out of both.

    The standard error is that of the jackknife over slices, so that a few slices do not make a stack mirrored.

    Args:
        value: [P] pixels.
        here: [P] their prediction by a volume of the other stacks.
        mirrored: [P] their prediction by its mirror image.
        plane: [P] slice of each pixel.

    Returns:
        None where there are too few pixels, or where they show something else.
    """
    both = np.stack([np.ones_like(here), here + mirrored], 1).astype(np.float64)
    targets = np.stack([value, here - mirrored], 1).astype(np.float64)
    if (
        len(value) < MIN_PIXELS
        or min(value.std(), both[:, 1].std()) == 0
        or np.corrcoef(value, both[:, 1])[0, 1] ** 2 < MIN_CORRELATION**2
    ):
        return None
    fit = np.linalg.lstsq(both, targets, rcond=None)[0]
    left = targets - both @ fit
    products = np.stack([left[:, 0] ** 2, left[:, 1] ** 2, left[:, 0] * left[:, 1]])
    sums = np.stack([np.bincount(plane, one) for one in products])[:, np.unique(plane)]
    without_one = sums.sum(1)[:, None] - sums  # [3, K] of all slices but one
    if min(without_one[0].min(), without_one[1].min()) <= 0:
        return None
    n, correlations = sums.shape[1], without_one[2] / np.sqrt(without_one[0] * without_one[1])
    error = float(np.sqrt((n - 1) * correlations.var()))
    square, square_of_part, product = sums.sum(1)
    # both parts of a stack are as bright as it is, so the share is in units of its symmetric part
    share = product / square_of_part / fit[1, 0] if fit[1, 0] else 0.0
    return Asymmetry(float(product / np.sqrt(square * square_of_part)), error, float(share))
