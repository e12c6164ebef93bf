"""What the slices of a stack moved by together, carried on as far as stacks predict each other best.

Poses and volume in turn come slowly nearer to what two stacks hardly check: of a tilt or a shear that all slices of a
stack share, each round takes a part only, since the volume was made of the same slices. The rest lies in the same
direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.held_out import fine_held_out_correlations

MAX_FACTOR = 2.0
"""At most so many times the last move is added to it."""

LEAST_FACTOR = 0.1
"""Less is not worth another comparison."""

STRAY_MOVES = 3.0
"""Slices that moved by more than this many times the median count less in what is shared."""


@dataclass(frozen=True, kw_only=True)
class CarriedOn:
    """Slices after their shared move was carried on.

    Args:
        slices: at their new poses.
        factor: how many times the shared move was added; 0 where that helped nothing.
        held_out: mean held-out correlation at these poses.
    """

    slices: Slices
    factor: float
    held_out: float


def carried_on(slices: Slices, gain: NDArray[np.float64], before: RigidPose, held_out: float) -> CarriedOn:
    """Add to the last move of the slices a multiple of what is shared of it.

    The mean held-out correlation is taken to be a parabola of the multiple, through the values at 0, 1 and 2.

    Args:
        slices: K slices of two or more stacks, after the move.
        gain: [K] intensity factors.
        before: [K] poses of the slices before the move.
        held_out: mean of `fine_held_out_correlations` after the move.
    """
    move = shared_move(slices, before)

    def moved_on(factor: float) -> tuple[Slices, float]:
        step = RigidPose.from_rotvec(factor * move[:, :3], factor * move[:, 3:])
        further = slices.with_pose(slices.planes.pose @ step)
        return further, float(np.mean(fine_held_out_correlations(further, gain)))

    factor = _peak(held_out, moved_on(MAX_FACTOR / 2)[1], moved_on(MAX_FACTOR)[1])
    if factor >= LEAST_FACTOR:
        further, after = moved_on(factor)
        if after > held_out:
            return CarriedOn(slices=further, factor=factor, held_out=after)
    return CarriedOn(slices=slices, factor=0.0, held_out=held_out)


def shared_move(slices: Slices, before: RigidPose) -> NDArray[np.float64]:
    """The part of a move that changes linearly along each stack: rotation (rad) and translation (mm) [K, 6].

    In the frame of each slice: R <- R exp(rotation), t <- t + R translation.

    Args:
        slices: K slices after the move.
        before: [K] their poses before it.
    """
    last = before.inverse() @ slices.planes.pose
    move = np.concatenate([last.rotvec_rad(), last.translation_mm], axis=1)
    n_pixels = np.bincount(slices.pixel_plane, minlength=len(slices))
    shared = np.zeros_like(move)
    for stack in np.unique(slices.stack_id):
        rows = np.flatnonzero(slices.stack_id == stack)
        place = slices.slice_index[rows] - slices.slice_index[rows].mean()
        basis = np.stack([np.ones(len(rows)), place / max(1.0, float(np.abs(place).max()))], axis=1)
        length = np.linalg.norm(move[rows, 3:], axis=1)
        stray = length / max(STRAY_MOVES * float(np.median(length)), np.finfo(float).tiny)
        root = np.sqrt(n_pixels[rows] / (1 + stray**2))[:, None]
        coefficient = np.linalg.lstsq(basis * root, move[rows] * root, rcond=None)[0]
        shared[rows] = basis @ coefficient
    return shared


def _peak(at_zero: float, at_half: float, at_end: float) -> float:
    """Where the parabola through values at 0, `MAX_FACTOR` / 2 and `MAX_FACTOR` is highest, between the two ends."""
    bend, slope = (at_end - 2 * at_half + at_zero) / 2, (4 * at_half - at_end - 3 * at_zero) / 2
    if bend >= 0:
        return MAX_FACTOR if at_end > at_zero else 0.0
    return float(np.clip(-slope / (2 * bend), 0, 2)) * MAX_FACTOR / 2
