"""Slice-to-volume registration: Levenberg-Marquardt on all slices at once, robust, with gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import orthonormal, rotation_matrix
from g3r.registration.normal_equations import NormalEquations, SampledSlices

MAX_ROTATION_RAD, MAX_TRANSLATION_MM = 0.06, 2.0
"""Trust region of one step of a slice."""

GAIN_PRIOR_SIGMA = 0.3
"""Standard deviation of the prior on the logarithm of slice gains; keeps dark slices finite."""

NEIGHBOURS = (-2, -1, 1, 2)
"""Offsets of the slices of a stack that count as neighbours."""

TIE_SHARE = 0.01
"""Stiffness of the tie between neighbours, as a share of the median stiffness of a slice: it hardly affects a slice
through the middle of the head, while a slice of a few pixels at the edge follows its neighbours."""

UNSEEN_NORMAL_TIE = 0.3
"""The same along the normal of a slice that no other stack sees: the volume there was made of the slice and its
neighbours, and nothing else determines how far they are apart."""

TIE_REACH_MM = 3.0
"""Neighbours whose motion would move a slice further than this count less: after a jerk, and between the
passes of an interleaved stack, neighbours rightly lie elsewhere."""


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
        normal_tie: [K] further stiffness of the tie along the normal, see `UNSEEN_NORMAL_TIE`.

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
    """Give every slice the motion of a neighbour in the stack where that fits clearly better.

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
    for step in NEIGHBOURS:
        source = np.arange(len(slices)) + step
        valid = (source >= 0) & (source < len(slices))
        source = np.where(valid, source, np.arange(len(slices)))
        valid &= slices.stack_id[source] == slices.stack_id
        source = np.where(valid, source, np.arange(len(slices)))
        candidate = motion.take(source) @ slices.header_pose
        loss = model.losses(slices.planes.with_pose(candidate), gain, width)
        # a margin, because each slice helped to make the volume and so fits best where it is
        better = valid & (loss < 0.97 * best)
        best_pose = _where(better, candidate, best_pose)
        best = np.where(better, loss, best)
    return slices.with_pose(best_pose), int((best < current).sum())


@dataclass(frozen=True)
class NeighbourTie:
    """A quadratic penalty that ties every slice to where its neighbours in the stack would put it.

    Args:
        target: [K] mean of the neighbours' motions, weighted by how well each is determined, applied to the
            header pose of the slice.
        precision: [K, 6] of rotations (1/rad^2) and translations (1/mm^2), in units of the squared residuals.
    """

    target: RigidPose
    precision: NDArray[np.float64]

    @classmethod
    def of(
        cls, slices: Slices, equations: NormalEquations, normal_tie: NDArray[np.float64] | None = None
    ) -> NeighbourTie:
        """Ties for the present poses.

        Args:
            slices: K slices.
            equations: of their fit.
            normal_tie: [K] see `UNSEEN_NORMAL_TIE`.
        """
        n = len(slices)
        motion = slices.world_from_header()
        pose = slices.planes.pose
        information = np.einsum("kii->k", equations.hessian[:, 3:6, 3:6]) / 3
        # a rotation counts by how far it moves the edge of the slice; slices of a few pixels get a least radius
        half_mm = slices.planes.shape * slices.planes.spacing_mm / 2
        radius_mm = np.maximum(np.sqrt((half_mm**2).mean(1)), 10.0)
        rotation = np.zeros((n, 3, 3))
        translation, total = np.zeros((n, 3)), np.zeros(n)
        for step in NEIGHBOURS:
            source = np.arange(n) + step
            valid = (source >= 0) & (source < n)
            source = np.clip(source, 0, n - 1)
            valid &= slices.stack_id[source] == slices.stack_id
            candidate = motion.take(source) @ slices.header_pose
            angle = Rotation.from_matrix(pose.rotation.transpose(0, 2, 1) @ candidate.rotation).magnitude()
            shift_mm = np.linalg.norm(candidate.translation_mm - pose.translation_mm, axis=1)
            away_mm = np.hypot(shift_mm, radius_mm * angle)
            weight = np.where(valid, information[source] / (1 + (away_mm / TIE_REACH_MM) ** 2), 0.0)
            rotation += weight[:, None, None] * candidate.rotation
            translation += weight[:, None] * candidate.translation_mm
            total += weight
        alone = total <= 0
        safe = np.where(alone, 1.0, total)
        target = RigidPose(
            orthonormal(np.where(alone[:, None, None], pose.rotation, rotation / safe[:, None, None])),
            np.where(alone[:, None], pose.translation_mm, translation / safe[:, None]),
        )
        stiffness = np.where(alone, 0.0, TIE_SHARE * float(np.median(information)))
        precision = np.repeat(np.stack([stiffness * radius_mm**2, stiffness], axis=1), 3, axis=1)
        if normal_tie is not None:
            precision[:, 5] += np.where(alone, 0.0, normal_tie * float(np.median(information)))
        return cls(target, precision)

    def twist(self, pose: RigidPose) -> NDArray[np.float64]:
        """Body-frame rotation and translation [K, 6] from poses to the target."""
        back = pose.rotation.transpose(0, 2, 1)
        rotation = Rotation.from_matrix(back @ self.target.rotation).as_rotvec()
        translation = np.einsum("kij,kj->ki", back, self.target.translation_mm - pose.translation_mm)
        return np.concatenate([rotation, translation], axis=1)

    def cost(self, pose: RigidPose) -> NDArray[np.float64]:
        """Penalty of each slice [K]."""
        return 0.5 * (self.precision * self.twist(pose) ** 2).sum(1)


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
