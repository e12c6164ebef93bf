"""Slice-to-volume registration: Levenberg-Marquardt on all slices at once, robust, with gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import orthonormal, rotation_matrix
from g3r.registration.normal_equations import NormalEquations, SampledSlices
from g3r.registration.slice_neighbours import NeighbourTie, neighbours

MAX_ROTATION_RAD, MAX_TRANSLATION_MM = 0.06, 2.0
"""Trust region of one step of a slice."""

GAIN_PRIOR_SIGMA = 0.3
"""Standard deviation of the prior on the logarithm of slice gains; keeps dark slices finite."""


def register_slices(
    model: SampledSlices,
    slices: Slices,
    gain: NDArray[np.float64],
    *,
    n_steps: int,
    width: float,
    normal_tie: NDArray[np.float64] | None = None,
) -> tuple[Slices, NDArray[np.float64], NormalEquations]:
    """Levenberg-Marquardt steps for every slice at once, each with its own damping.

    Args:
        model: the pixels of the slices and the volume.
        slices: K slices at their present poses.
        gain: [K] present intensity factors.
        n_steps: number of evaluations.
        width: residual at which the Cauchy loss bends.
        normal_tie: [K] further stiffness of the tie along the normal, see `NeighbourTie.of`.

    Returns:
        Slices in new poses, new gains, and the statistics at them.
    """
    pose = slices.planes.pose
    log_gain = np.log(gain)
    damping = np.full(len(slices), 1e-2)
    current = model.evaluate(slices.planes, gain, width)
    tie = NeighbourTie.of(slices, current, normal_tie)
    for _ in range(n_steps):
        step = _solve(current, log_gain, damping, width, tie, pose)
        trial_pose = RigidPose(
            orthonormal(pose.rotation @ rotation_matrix(step[:, :3])),
            pose.translation_mm + np.einsum("kij,kj->ki", pose.rotation, step[:, 3:6]),
        )
        trial_log_gain = log_gain + step[:, 6]
        trial = model.evaluate(slices.planes.with_pose(trial_pose), np.exp(trial_log_gain), width)
        better = _objective(trial, width) + tie.cost(trial_pose) < _objective(current, width) + tie.cost(pose)
        pose = _where(better, trial_pose, pose)
        log_gain = np.where(better, trial_log_gain, log_gain)
        current = _where_equations(better, trial, current)
        damping = np.where(better, np.maximum(damping / 3, 1e-4), damping * 6)
    return slices.with_pose(pose), np.exp(log_gain - log_gain.mean()), current


def try_neighbours(
    model: SampledSlices, slices: Slices, gain: NDArray[np.float64], *, width: float
) -> tuple[Slices, int]:
    """Give every slice the motion of a neighbour where that fits clearly better.

    A slice in a wrong local minimum sees no gradient towards its place; its neighbours are mostly near it.

    Args:
        model: the pixels of the slices and the volume.
        slices: K slices at their present poses.
        gain: [K] intensity factors.
        width: residual at which the Cauchy loss bends.

    Returns:
        The slices, and how many took another motion.
    """
    motion = slices.world_from_header()
    best_pose = slices.planes.pose
    current = model.losses(slices.planes, gain, width)
    best = current.copy()
    for source in neighbours(slices):
        candidate = motion.take(source) @ slices.header_pose
        loss = model.losses(slices.planes.with_pose(candidate), gain, width)
        # a margin, because each slice helped to make the volume and so fits best where it is
        better = loss < 0.97 * best
        best_pose = _where(better, candidate, best_pose)
        best = np.where(better, loss, best)
    return slices.with_pose(best_pose), int((best < current).sum())


def _objective(equations: NormalEquations, width: float) -> NDArray[np.float64]:
    """Cauchy loss of each slice [K], scaled to half a sum of squares where residuals are small."""
    return 0.5 * width**2 * equations.loss * equations.moments[:, 0]


def _solve(
    equations: NormalEquations,
    log_gain: NDArray[np.float64],
    damping: NDArray[np.float64],
    width: float,
    tie: NeighbourTie,
    pose: RigidPose,
) -> NDArray[np.float64]:
    hessian, gradient = equations.hessian.copy(), equations.gradient.copy()
    precision = (width / GAIN_PRIOR_SIGMA) ** 2
    hessian[:, 6, 6] += precision
    gradient[:, 6] -= precision * log_gain
    gradient[:, :6] += tie.precision * tie.twist(pose)
    hessian[:, np.arange(6), np.arange(6)] += tie.precision
    diagonal = np.einsum("kii->ki", hessian)
    # relative to the largest rotation or translation, so that an edge slice without contrast stays in place
    floor = np.repeat([1e-3, 1e-3, 1.0], [3, 3, 1]) * np.repeat(
        np.stack([diagonal[:, :3].max(1), diagonal[:, 3:6].max(1), diagonal[:, 6]], 1), [3, 3, 1], axis=1
    )
    hessian += np.eye(7) * (damping[:, None] * diagonal + floor * 1e-2 + 1e-20)[:, None, :]
    step = np.asarray(np.linalg.solve(hessian, gradient[..., None])[..., 0], dtype=np.float64)
    step[:, :3] *= _limit(step[:, :3], MAX_ROTATION_RAD)
    step[:, 3:6] *= _limit(step[:, 3:6], MAX_TRANSLATION_MM)
    step[:, 6] = np.clip(step[:, 6], -0.3, 0.3)
    return step


def _limit(vectors: NDArray[np.float64], longest: float) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.minimum(1.0, longest / np.maximum(length, 1e-30))


def _where(take_first: NDArray[np.bool_], first: RigidPose, second: RigidPose) -> RigidPose:
    return RigidPose(
        np.where(take_first[:, None, None], first.rotation, second.rotation),
        np.where(take_first[:, None], first.translation_mm, second.translation_mm),
    )


def _where_equations(take_first: NDArray[np.bool_], first: NormalEquations, second: NormalEquations) -> NormalEquations:
    chosen = []
    for name in NormalEquations.__dataclass_fields__:
        a, b = getattr(first, name), getattr(second, name)
        chosen.append(np.where(take_first.reshape(-1, *(1,) * (a.ndim - 1)), a, b))
    return NormalEquations(*chosen)
