"""Neighbours of slices, and the weak spring that ties each slice to where they would put it.

A head that moves is where it was when the slice before was taken. Where every fourth or fifth slice is taken in turn,
slices beside each other in space are a whole pass apart in time, and their motions have nothing to do with each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import orthonormal
from g3r.registration.motion_segments import estimate_interleave, time_orders
from g3r.registration.normal_equations import NormalEquations

OFFSETS = (-2, -1, 1, 2)
"""Places of the neighbours of a slice, relative to it: in space up to `IN_SPACE_UP_TO`, else in the order of time."""

IN_SPACE_UP_TO = 2
"""Interleave up to which neighbours in space count: half of them or more are neighbours in time, too, and the others
tie the two passes to each other. With neighbours in time alone, cases of interleave 2 change by -0.4 to +0.2 dB
(`fast`, by hand). Seven heads in severe motion whose every fourth or fifth slice was taken in turn had 11 to 51 %
of their brain more than 2 mm off with neighbours in space, and have at most 0.3 % with those in time (`fast`, by
hand)."""

TIE_SHARE = 0.01
"""Stiffness of the tie between neighbours, as a share of the median stiffness of a slice: it hardly affects a slice
through the middle of the head, while a slice of a few pixels at the edge follows its neighbours."""

UNSEEN_NORMAL_TIE = 0.3
"""The same along the normal of a slice that no other stack sees: the volume there was made of the slice and its
neighbours, and nothing else determines how far they are apart."""

TIE_REACH_MM = 3.0
"""Neighbours whose motion would move a slice further than this count less: after a jerk they rightly lie elsewhere."""


def neighbours(slices: Slices) -> list[NDArray[np.int64]]:
    """For each of `OFFSETS` the row [K] of that neighbour of each slice; its own row where there is none.

    The order in time of each stack is taken to be the one in which its present motions change least.

    Args:
        slices: K slices at their present poses.
    """
    motion = slices.world_from_header()
    middle_mm = slices.header_pose.apply(slices.planes.corners_mm()).mean(1)
    found = [np.arange(len(slices)) for _ in OFFSETS]
    for stack in np.unique(slices.stack_id):
        rows = np.flatnonzero(slices.stack_id == stack)
        number = slices.slice_index[rows]
        # where little moved, noise would choose the order
        interleave = estimate_interleave(motion.take(rows), number, middle_mm[rows].mean(0), usual=IN_SPACE_UP_TO)
        ordered = rows[np.argsort(number) if interleave <= IN_SPACE_UP_TO else time_orders(number)[interleave]]
        for source, offset in zip(found, OFFSETS, strict=True):
            if offset > 0:
                source[ordered[:-offset]] = ordered[offset:]
            else:
                source[ordered[-offset:]] = ordered[:offset]
    return found


@dataclass(frozen=True)
class NeighbourTie:
    """A quadratic penalty that ties every slice to where its neighbours would put it.

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
        for source in neighbours(slices):
            candidate = motion.take(source) @ slices.header_pose
            angle = Rotation.from_matrix(pose.rotation.transpose(0, 2, 1) @ candidate.rotation).magnitude()
            shift_mm = np.linalg.norm(candidate.translation_mm - pose.translation_mm, axis=1)
            away_mm = np.hypot(shift_mm, radius_mm * angle)
            is_other = source != np.arange(n)
            weight = np.where(is_other, information[source] / (1 + (away_mm / TIE_REACH_MM) ** 2), 0.0)
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
