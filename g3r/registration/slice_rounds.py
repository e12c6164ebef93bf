"""Volume and slice poses in alternation: every slice is a rigid body of its own, coarse to fine."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.bounding_grid import grid_around
from g3r.acquisition.least_squares import solve_volume
from g3r.acquisition.planes import Slices
from g3r.acquisition.robust import robust_width, slice_weights
from g3r.acquisition.thinning import thinned
from g3r.acquisition.voxel_operator import VoxelOperator
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.settings import RegistrationSettings
from g3r.registration.similarity import best_gain
from g3r.registration.slice_neighbours import UNSEEN_NORMAL_TIE
from g3r.registration.slice_registration import register_slices, try_neighbours
from g3r.registration.stray_slices import find_strays
from g3r.run.deadline import Deadline, timed_steps
from g3r.run.progress import Progress, no_progress

logger = logging.getLogger(__name__)


MIN_ROUNDS = 3
"""Rounds that run whatever the deadline: one with coarse voxels and two with the finest."""

N_ROUNDS_IN_PLACE = 3
"""Rounds of gains and weights at fixed poses. Gains settle in them; with more, the weights of tips of few pixels would
fall on and on, since the volume is made without them."""

GAIN_RANGE_IN_PLACE = (0.05, 20.0)
"""Range of gains of slices whose poses are given: wide, so that the gain of a slice without signal shows the loss."""

ROUNDS_AFTER_SEARCH = 3
"""Rounds after a search for strays. While slices were astray, the others did not find their places either: one round
gave six volumes in severe motion 0.1 dB less in the mean than two, and 0.25 dB less than four (`fast`, by hand)."""

FINEST_FROM = 0.4
"""Share of the rounds after which voxels are the finest."""

OVER_RELAXATION = 1.8
"""Factor by which the moves of a round with the finest voxels are made longer (successive over-relaxation, Young 1954).
Without it, slices and volume, found in turn, converge in steps that shrink by a fifth from round to round, all in one
direction."""

CARRIED_ON_MM, CARRIED_ON_RAD = 1.0, 0.03
"""Longest moves that are made longer: slices with longer moves are on their way to another place."""

VOLUME_STEPS = 5
"""Conjugate-gradient steps of each round, from the last volume on: three more changed no pose by 0.05 mm."""

CONTINUED_VOXELS = 1.5
"""Standard deviation, in voxels, of the blur that continues a volume beyond the masks."""

LEAST_SEEN = 1e-6
"""Share of the highest blurred coverage below which a voxel is too far from all masks for a continued value."""


@dataclass(frozen=True, kw_only=True)
class FittedSlices:
    """Slices at their last poses with gain, weight and correlation [K], and figures of each round."""

    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    history: list[dict[str, float]]


def refine_slices(
    slices: Slices,
    settings: RegistrationSettings,
    progress: Progress = no_progress,
    deadline: Deadline | None = None,
    seen_share: NDArray[np.float64] | None = None,
) -> FittedSlices:
    """Register every slice to the volume of all slices, which is made anew in each round.

    Args:
        slices: at poses right to a few millimetres.
        settings: number of rounds and steps, finest voxel, number of pixels.
        progress: called with the rounds done and their total.
        deadline: fewer rounds if they would end after it.
        seen_share: [K] share of each slice that other stacks see; None where nothing is missing.
    """
    rounds = _Rounds(slices, settings, seen_share)
    for number, done in timed_steps(settings.n_rounds, deadline, least=MIN_ROUNDS):
        progress(number, settings.n_rounds)
        # 1 in the last round; rounded, so that its steps do not depend on the last digit
        rounds.run(round(min(1.0, done * settings.n_rounds / max(1, settings.n_rounds - 1)), 9))
    rng = np.random.default_rng(settings.seed)
    for _ in range(settings.stray_searches if settings.n_rounds else 0):
        if deadline is not None and deadline.record_whether_passed():
            break
        rounds.slices, n_found = find_strays(rounds.slices, rounds.gain, rounds.weight, rounds.ncc, rng)
        if not n_found:
            break
        logger.info("slices: %d that went astray were found again", n_found)
        for number in range(ROUNDS_AFTER_SEARCH):
            rounds.run(1.0, 0 if number else n_found)
    n_rounds = max(settings.n_rounds, 1)  # a single stack has none, and is done
    progress(n_rounds, n_rounds)
    slices, gain, weight = rounds.slices, rounds.gain, rounds.weight
    ncc = correlation_with_all(slices, gain, weight, settings.finest_voxel_mm, settings.max_pixels)
    return FittedSlices(slices=slices, gain=gain, weight=weight, ncc=ncc, history=rounds.history)


class _Rounds:
    """The state after the last round: slices, gains and weights, and the volume of all slices.

    Args:
        slices, settings, seen_share: see `refine_slices`.
    """

    def __init__(self, slices: Slices, settings: RegistrationSettings, seen_share: NDArray[np.float64] | None) -> None:
        self.slices, self.settings = slices, settings
        self.normal_tie = None if seen_share is None else UNSEEN_NORMAL_TIE * (1 - seen_share) ** 2
        self.gain, self.weight, self.ncc = (np.ones(len(slices)) for _ in range(3))
        self.volume: NDArray[np.float32] | None = None
        self.grid: VolumeGrid | None = None
        self.history: list[dict[str, float]] = []

    def run(self, fraction: float, n_found: int = 0) -> None:
        """One round.

        Args:
            fraction: share of the rounds that is done, from 0 to 1, which decides how fine this one is.
            n_found: number of slices that were placed anew just before, for the history.
        """
        settings, before = self.settings, self.slices
        # coarse to fine: the capture range is about a voxel of the volume's blur. Few coarse rounds, since blur moves
        # round surfaces inwards, and slices follow them along their normals
        voxel = settings.finest_voxel_mm * (2.4 if fraction < 0.1 else 1.6 if fraction < FINEST_FROM else 1.0)
        smoothness = 0.1 if fraction < 0.2 else 0.03 if fraction < 0.7 else 0.01
        if self.grid is None or not np.isclose(self.grid.spacing_mm[0], voxel):
            self.grid, self.volume = grid_around(self.slices, voxel), None
        n_pixels = round(settings.max_pixels / (voxel / settings.finest_voxel_mm))
        self.volume = _volume_of(self.slices, self.grid, self.gain, self.weight, self.volume, smoothness, n_pixels)
        model = SampledSlices(self.slices, self.volume, self.grid, n_pixels=n_pixels)
        width = robust_width(model.residuals(self.slices.planes, self.gain), n_sigma=2)
        moved = n_found
        if 0.1 < fraction < 0.8:
            self.slices, moved = try_neighbours(model, self.slices, self.gain, width=width)
        self.slices, self.gain, fit = register_slices(
            model, self.slices, self.gain, n_steps=settings.steps_per_round, width=width, normal_tie=self.normal_tie
        )
        self.weight, self.ncc = slice_weights(fit.loss, self.gain, self.slices.n_stacks), fit.ncc
        if fraction >= FINEST_FROM:
            self.slices = carried_on(before, self.slices, OVER_RELAXATION)
        number, median_ncc = len(self.history), float(np.median(fit.ncc))
        self.history.append(
            {"round": number, "voxel_mm": voxel, "residual": width / 2, "median_ncc": median_ncc, "moved": moved}
        )
        logger.info("slices, round %d: voxel %.1f mm, residual %.4f, moved %d", number + 1, voxel, width / 2, moved)


def carried_on(before: Slices, after: Slices, factor: float) -> Slices:
    """Slices moved further in the direction of their last move.

    Args:
        before: slices before the move.
        after: the same slices after it; those that went far or turned far stay there.
        factor: length of the whole move over that made; 1 leaves all in place.
    """
    now = after.planes.pose
    move = before.planes.pose.inverse() @ now
    turned, went = move.rotvec_rad(), move.translation_mm
    near = (np.linalg.norm(went, axis=1) < CARRIED_ON_MM) & (np.linalg.norm(turned, axis=1) < CARRIED_ON_RAD)
    more = np.where(near, factor - 1, 0.0)[:, None]
    return after.with_pose(now @ RigidPose.from_rotvec(more * turned, more * went))


def fitted_in_place(slices: Slices, settings: RegistrationSettings, progress: Progress = no_progress) -> FittedSlices:
    """Gains, weights and correlations of slices at fixed poses, as `refine_slices` finds them.

    Slices of a single stack, which explain themselves, keep a gain and a weight of 1, as there.

    Args:
        slices: at their poses.
        settings: voxel of the volume, number of pixels.
        progress: called with the rounds done and their total.
    """
    voxel, n_rounds = settings.finest_voxel_mm, N_ROUNDS_IN_PLACE if slices.n_stacks > 1 else 0
    gain, weight = np.ones(len(slices)), np.ones(len(slices))
    grid, volume = grid_around(slices, voxel), None
    history: list[dict[str, float]] = []
    for number in range(n_rounds):
        progress(number, n_rounds)
        volume = _volume_of(slices, grid, gain, weight, volume, 0.03, settings.max_pixels)
        model = SampledSlices(slices, volume, grid, n_pixels=settings.max_pixels)
        width = robust_width(model.residuals(slices.planes, gain), n_sigma=2)
        fit = model.evaluate(slices.planes, gain, width)
        log_gain = np.log(best_gain(fit.moments, GAIN_RANGE_IN_PLACE))
        gain = np.exp(log_gain - log_gain.mean())
        fit = model.evaluate(slices.planes, gain, width)
        weight = slice_weights(fit.loss, gain, slices.n_stacks)
        ncc = float(np.median(fit.ncc))
        history.append({"round": number, "voxel_mm": voxel, "residual": width / 2, "median_ncc": ncc, "moved": 0})
        logger.info("slices in place, round %d: residual %.4f", number + 1, width / 2)
    progress(max(n_rounds, 1), max(n_rounds, 1))
    ncc_of_all = correlation_with_all(slices, gain, weight, voxel, settings.max_pixels)
    return FittedSlices(slices=slices, gain=gain, weight=weight, ncc=ncc_of_all, history=history)


def _volume_of(
    slices: Slices,
    grid: VolumeGrid,
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    start: NDArray[np.float32] | None,
    smoothness: float,
    n_pixels: int,
) -> NDArray[np.float32]:
    index = slices.pixel_index[thinned(len(slices.pixel_index), n_pixels)]
    operator = VoxelOperator(slices.planes, grid, index, (1, 1, 5))
    value = slices.value[index] / gain[operator.plane]
    pixel_weight = weight[operator.plane].astype(np.float32)
    if start is None:
        start = continued_outwards(operator, value.astype(np.float32), pixel_weight)
    else:  # pixels far from the present volume (spikes, signal loss) count less
        residual = value - operator.forward(start)
        width = robust_width(residual, n_sigma=3)
        pixel_weight = (pixel_weight / (1 + (residual / width) ** 2)).astype(np.float32)
    return solve_volume(
        operator, value.astype(np.float32), pixel_weight, start=start, n_iterations=VOLUME_STEPS, smoothness=smoothness
    )


def continued_outwards(
    operator: VoxelOperator, value: NDArray[np.float32], weight: NDArray[np.float32]
) -> NDArray[np.float32]:
    """A blurred volume [I, J, K] that continues beyond the masks with its values at their rim.

    Zeros there would count as what lies outside: pixels of the rim would seem too bright, and their slices would
    move inwards at no cost, since pixels outside the mask are not compared. Normalised convolution (Knutsson and Westin
    1993) takes no account of what was not seen.
    """
    bright = gaussian_filter(operator.adjoint(weight * value), CONTINUED_VOXELS, truncate=6.0)
    seen = gaussian_filter(operator.adjoint(weight), CONTINUED_VOXELS, truncate=6.0)
    near = seen > LEAST_SEEN * seen.max(initial=0)
    return np.divide(bright, seen, out=np.zeros_like(bright), where=near)


def correlation_with_all(
    slices: Slices, gain: NDArray[np.float64], weight: NDArray[np.float64], voxel_mm: float, max_pixels: int
) -> NDArray[np.float64]:
    """Correlation of each slice [K] with a volume made of all of them.

    Args:
        slices: at their present poses.
        gain: [K] intensity factors.
        weight: [K] slice weights.
        voxel_mm: of the volume.
        max_pixels: number of pixels in use, at most.
    """
    grid = grid_around(slices, voxel_mm)
    volume = _volume_of(slices, grid, gain, weight, None, 0.03, max_pixels)
    return SampledSlices(slices, volume, grid, n_pixels=max_pixels).evaluate(slices.planes, gain, 1.0).ncc
