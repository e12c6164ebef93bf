"""Slice-to-volume registration: batched damped Gauss-Newton of all slices, robust, with gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import orthonormal, rotation_matrix
from g3r.motion.normal_equations import NormalEquations, SliceModel

LARGEST_TURN_RAD, LARGEST_SHIFT_MM = 0.06, 2.0
"""Trust region of one step of a slice."""

GAIN_PRIOR_SIGMA = 0.3
"""Spread of the logarithm of slice gains before the image speaks (a prior; keeps dark slices finite)."""

NEIGHBOURS = (-2, -1, 1, 2)


def register_slices(
    model: SliceModel,
    slices: Slices,
    gain: NDArray[np.float64],
    *,
    n_steps: int,
    width: float,
) -> tuple[Slices, NDArray[np.float64], NormalEquations]:
    """Levenberg-Marquardt steps for every slice at once, each with a damping of its own.

    Args:
        model: the slices' pixels and the volume.
        slices: K slices at their present poses.
        gain: [K] present intensity factors.
        n_steps: number of evaluations.
        width: residual at which the Cauchy loss bends.

    Returns:
        Slices in new poses, new gains, and the statistics at them.
    """
    pose = slices.planes.pose
    log_gain = np.log(gain)
    damping = np.full(len(slices), 1e-2)
    current = model.evaluate(slices.planes, gain, width)
    for _ in range(n_steps):
        step = _solve(current, log_gain, damping, width)
        trial_pose = RigidPose(
            orthonormal(pose.rotation @ rotation_matrix(step[:, :3])),
            pose.translation_mm + np.einsum("kij,kj->ki", pose.rotation, step[:, 3:6]),
        )
        trial_log_gain = log_gain + step[:, 6]
        trial = model.evaluate(slices.planes.with_pose(trial_pose), np.exp(trial_log_gain), width)
        better = trial.loss < current.loss
        pose = _choose(better, trial_pose, pose)
        log_gain = np.where(better, trial_log_gain, log_gain)
        current = _choose_equations(better, trial, current)
        damping = np.where(better, np.maximum(damping / 3, 1e-4), damping * 6)
    return slices.with_pose(pose), np.exp(log_gain - log_gain.mean()), current


def try_neighbours(
    model: SliceModel, slices: Slices, gain: NDArray[np.float64], *, width: float
) -> tuple[Slices, int]:
    """Offer every slice the motions of its neighbours in the stack, and keep what fits clearly better.

    A slice that locked on wrongly sees no gradient towards its place; its neighbours mostly lie there.

    Returns:
        The slices, and how many took another motion.
    """
    motion = slices.world_from_header()
    best_pose = slices.planes.pose
    current = model.evaluate(slices.planes, gain, width).loss
    best = current.copy()
    for step in NEIGHBOURS:
        source = np.arange(len(slices)) + step
        valid = (source >= 0) & (source < len(slices))
        source = np.where(valid, source, np.arange(len(slices)))
        valid &= slices.stack_id[source] == slices.stack_id
        source = np.where(valid, source, np.arange(len(slices)))
        candidate = motion.take(source) @ slices.header_pose
        loss = model.evaluate(slices.planes.with_pose(candidate), gain, width).loss
        # a margin, because each slice helped to make the volume and so prefers its present place
        better = valid & (loss < 0.97 * best)
        best_pose = _choose(better, candidate, best_pose)
        best = np.where(better, loss, best)
    return slices.with_pose(best_pose), int((best < current).sum())


def _solve(
    equations: NormalEquations, log_gain: NDArray[np.float64], damping: NDArray[np.float64], width: float
) -> NDArray[np.float64]:
    hessian, gradient = equations.hessian.copy(), equations.gradient.copy()
    precision = (width / GAIN_PRIOR_SIGMA) ** 2
    hessian[:, 6, 6] += precision
    gradient[:, 6] -= precision * log_gain
    diagonal = np.einsum("kii->ki", hessian)
    # relative to the largest turn or shift, so that an edge slice without contrast stays where it is
    floor = np.repeat([1e-3, 1e-3, 1.0], [3, 3, 1]) * np.repeat(
        np.stack([diagonal[:, :3].max(1), diagonal[:, 3:6].max(1), diagonal[:, 6]], 1), [3, 3, 1], axis=1
    )
    hessian += np.eye(7) * (damping[:, None] * diagonal + floor * 1e-2 + 1e-20)[:, None, :]
    step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
    step[:, :3] *= _limit(step[:, :3], LARGEST_TURN_RAD)
    step[:, 3:6] *= _limit(step[:, 3:6], LARGEST_SHIFT_MM)
    step[:, 6] = np.clip(step[:, 6], -0.3, 0.3)
    return step


def _limit(vectors: NDArray[np.float64], longest: float) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.minimum(1.0, longest / np.maximum(length, 1e-30))


def _choose(take_first: NDArray[np.bool_], first: RigidPose, second: RigidPose) -> RigidPose:
    return RigidPose(
        np.where(take_first[:, None, None], first.rotation, second.rotation),
        np.where(take_first[:, None], first.translation_mm, second.translation_mm),
    )


def _choose_equations(
    take_first: NDArray[np.bool_], first: NormalEquations, second: NormalEquations
) -> NormalEquations:
    chosen = []
    for name in ("hessian", "gradient", "loss", "moments"):
        a, b = getattr(first, name), getattr(second, name)
        chosen.append(np.where(take_first.reshape(-1, *(1,) * (a.ndim - 1)), a, b))
    return NormalEquations(*chosen)
