"""Motion segments between jerks: the most likely sequence of motions in time, among candidates.

A fetus keeps still, jerks, and keeps still again. So the motions of a stack's slices, in the order of their
acquisition, are a few constant segments with small changes inside. Given the cost of each slice under each
candidate motion, dynamic programming finds the sequence with the least sum of these costs and of a transition
penalty for every change, which grows with the distance (Viterbi 1967). It needs no threshold for what a jerk
is, and finds at the same time how the stack was interleaved: the order in which the motions change least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.interleave import acquisition_order
from g3r.geometry import RigidPose

INTERLEAVES = tuple(range(1, 8))
"""Interleaves to try; the first of equally good ones is taken. Scanners take every second slice, or one of as many as
there are packages; some step by the root of the number of slices, which is 7 for 48."""

USUAL_INTERLEAVE = 3
UNUSUAL_PENALTY = 20.0
"""Cost (log odds) of an interleave above the usual ones, since few slices follow some order of seven by chance. Set on
two such sets of `stress.drawn`, and two heads whose every fifth slice was taken in turn (docs/stress.md)."""

HEAD_RADIUS_MM = 30.0
"""Half the diameter of a typical head, by which rotations are compared with translations."""

CHANGE_PENALTY = 6.0
"""Cost (log odds) of any change of motion from one slice in time to the next."""
DISTANCE_PENALTY = 8.0
"""Further cost of a change by d mm: this times log(1 + (d / STEADY_MM)^2); heavy-tailed, as jerks are."""
STEADY_MM = 4.0
"""Movement between slices of up to about this is ordinary."""

SAME_PLACE_MM = 1e-3
"""Motions closer to each other than this are the same."""

WINDOW = 5
"""Number of consecutive slices in time whose joint cost preselects candidates."""
BEST_PER_WINDOW = 6


@dataclass(frozen=True)
class Segments:
    """The chosen candidate of each slice.

    Args:
        choice: [K] candidate of each slice, in the order of the slices given.
        interleave: the acquisition order with the least cost.
        cost: of the whole sequence.
        n_segments: constant segments in it.
    """

    choice: NDArray[np.int64]
    interleave: int
    cost: float
    n_segments: int = 1


def time_orders(slice_index: NDArray[np.int64]) -> dict[int, NDArray[np.int64]]:
    """The slices [K] of one stack in the order of their acquisition, for each interleave.

    Args:
        slice_index: [K] numbers of the slices in their stack; some may be missing.
    """
    place = {int(number): k for k, number in enumerate(slice_index)}
    n = int(slice_index.max()) + 1
    return {
        interleave: np.array([place[q] for q in acquisition_order(n, interleave).tolist() if q in place])
        for interleave in INTERLEAVES
    }


def order_penalty(interleave: int, usual: int = USUAL_INTERLEAVE) -> float:
    """Cost of an order before anything was seen of the motion; orders up to `usual` cost nothing."""
    return UNUSUAL_PENALTY if interleave > usual else 0.0


def head_distance_mm(a: RigidPose, b: RigidPose, center_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distance [A, B] between where motions a and b take a ball of `HEAD_RADIUS_MM`.

    Args:
        a: A motions.
        b: B motions.
        center_mm: [3] centre of the ball before the motions.
    """
    place_a = a.rotation @ center_mm + a.translation_mm
    place_b = b.rotation @ center_mm + b.translation_mm
    translation = ((place_a[:, None] - place_b[None]) ** 2).sum(-1)
    trace = np.einsum("aij,bij->ab", a.rotation, b.rotation, optimize=True)
    return _ball_distance_mm(translation, trace)


def _ball_distance_mm(translation_mm2: NDArray[np.float64], trace: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distance [...] between the places of a ball of `HEAD_RADIUS_MM` under two motions.

    For a ball of radius r about the centre, mean |(R_a - R_b) x|^2 = 2 (3 - trace(R_a^T R_b)) r^2 / 5.

    Args:
        translation_mm2: [...] squared distance between the two places of its centre.
        trace: [...] of R_a^T R_b.
    """
    return np.sqrt(translation_mm2 + 2 * np.maximum(3 - trace, 0) * HEAD_RADIUS_MM**2 / 5)


def best_segments(
    cost: NDArray[np.float64],
    motion: RigidPose,
    slice_index: NDArray[np.int64],
    center_mm: NDArray[np.float64],
    keep: NDArray[np.int64] | None = None,
) -> Segments:
    """The cheapest sequence of candidate motions for one stack, in an unusual order only if that costs much less.

    Args:
        cost: [K, J] of slice k under candidate j (negative log likelihood).
        motion: J candidate motions of the world.
        slice_index: [K] numbers of the slices in their stack.
        center_mm: [3] centre of the head before the motions.
        keep: candidates to consider besides those that `promising` picks.
    """
    orders = time_orders(slice_index)
    usual = {n: order for n, order in orders.items() if n <= USUAL_INTERLEAVE}
    unusual = {n: order for n, order in orders.items() if n > USUAL_INTERLEAVE}
    best = _best_of_orders(cost, motion, usual, center_mm, keep)
    other = _best_of_orders(cost, motion, unusual, center_mm, keep)
    return other if other.cost + UNUSUAL_PENALTY < best.cost else best


def _best_of_orders(
    cost: NDArray[np.float64],
    motion: RigidPose,
    orders: dict[int, NDArray[np.int64]],
    center_mm: NDArray[np.float64],
    keep: NDArray[np.int64] | None,
) -> Segments:
    """The cheapest sequence in some of the orders of `time_orders`; arguments as of `best_segments`."""
    chosen = promising(cost, orders)
    if keep is not None:
        chosen = np.union1d(chosen, keep)
    motion, cost = motion.take(chosen), cost[:, chosen]
    penalty = transition_penalties(motion, center_mm)
    best: Segments | None = None
    for interleave, order in orders.items():
        path, total = cheapest_path(cost[order], penalty)
        if best is None or total < best.cost:
            choice = np.empty(len(cost), np.int64)
            choice[order] = chosen[path]
            best = Segments(choice, interleave, total, 1 + int((np.diff(path) != 0).sum()))
    assert best is not None
    return best


def transition_penalties(motion: RigidPose, center_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Penalty [J, J] of a change from each motion to each other; zero for staying.

    Args:
        motion: J motions of the world.
        center_mm: [3] centre of the head before the motions.
    """
    distance_mm = head_distance_mm(motion, motion, center_mm)
    return np.where(distance_mm > SAME_PLACE_MM, _penalty(distance_mm), 0.0)


def _penalty(distance_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    return CHANGE_PENALTY + DISTANCE_PENALTY * np.log1p((distance_mm / STEADY_MM) ** 2)


def changes_in_time(
    motion: RigidPose, slice_index: NDArray[np.int64], center_mm: NDArray[np.float64], interleave: int
) -> NDArray[np.float64]:
    """How far the head moved [K - 1] (mm) between consecutive slices of a stack in time.

    Args:
        motion: [K] world from header.
        slice_index: [K] numbers of the slices in their stack.
        center_mm: [3] centre of the head before the motions.
        interleave: acquisition order.
    """
    ordered = motion.take(time_orders(slice_index)[interleave])
    place = ordered.rotation @ center_mm + ordered.translation_mm
    translation = (np.diff(place, axis=0) ** 2).sum(1)
    trace = np.einsum("tij,tij->t", ordered.rotation[:-1], ordered.rotation[1:])
    return _ball_distance_mm(translation, trace)


def transition_penalty(distance_mm: NDArray[np.float64]) -> float:
    """Penalty of all movements [K - 1] (mm) of a stack; no movement costs nothing."""
    return float(_penalty(distance_mm[distance_mm > SAME_PLACE_MM]).sum())


def estimate_interleave(
    motion: RigidPose, slice_index: NDArray[np.int64], center_mm: NDArray[np.float64], usual: int = USUAL_INTERLEAVE
) -> int:
    """The interleave under which the motions of a stack change least.

    Args:
        motion: [K] world from header.
        slice_index: [K] numbers of the slices in their stack.
        center_mm: [3] centre of the head before the motions.
        usual: interleaves above this are taken only where they explain much more.
    """
    penalties = {
        n: order_penalty(n, usual) + transition_penalty(changes_in_time(motion, slice_index, center_mm, n))
        for n in time_orders(slice_index)
    }
    return min(penalties, key=lambda n: penalties[n])


def promising(cost: NDArray[np.float64], orders: dict[int, NDArray[np.int64]]) -> NDArray[np.int64]:
    """Candidates among the best of some window of slices in time, or the best of a single slice.

    Args:
        cost: [K, J] of slice k under candidate j.
        orders: slices in the order of their acquisition, by interleave.
    """
    n = len(cost)
    width = min(WINDOW, n)
    count = min(BEST_PER_WINDOW, cost.shape[1])
    found = [cost.argmin(1)]
    for order in orders.values():
        running = np.concatenate([np.zeros((1, cost.shape[1])), np.cumsum(cost[order], axis=0)])
        for first in {*range(0, n - width + 1, 2), n - width}:
            window = running[first + width] - running[first]
            found.append(np.argpartition(window, count - 1)[:count])
    return np.unique(np.concatenate(found))


def cheapest_path(cost: NDArray[np.float64], penalty: NDArray[np.float64]) -> tuple[NDArray[np.int64], float]:
    """The path [T] with the least sum of costs [T, J] and penalties [J, J] of changes, and that sum."""
    n, n_states = cost.shape
    total = cost[0].astype(np.float64)
    came_from = np.zeros((n, n_states), np.int64)
    for t in range(1, n):
        through = total[:, None] + penalty
        came_from[t] = through.argmin(0)
        total = through[came_from[t], np.arange(n_states)] + cost[t]
    path = np.empty(n, np.int64)
    path[-1] = total.argmin()
    for t in range(n - 1, 0, -1):
        path[t - 1] = came_from[t, path[t]]
    return path, float(total.min())
