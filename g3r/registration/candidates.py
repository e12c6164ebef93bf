"""Rival ideas of how the slices lie, and which of them predicts slices that it has not seen."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import fit_rigid_robust
from g3r.registration.normal_equations import SliceModel
from g3r.registration.placement import Placement, Prediction, StackSamples, predict, refine_placement, volume_without
from g3r.registration.segments import changes_in_time, time_orders, transition_penalty
from g3r.registration.so3_search import place_around, stack_orientations
from g3r.registration.stack_registration import refine_stack
from g3r.run.deadline import Deadline, timed_steps

logger = logging.getLogger(__name__)

HELD_OUT_VOXEL_MM = 3.2

ROUNDS = (
    (8.0, 4.0, 3.2),
    (8.0, 4.0, 3.2),
    (5.0, 3.0, 3.2),
    (5.0, 3.0, 3.2),
    (3.0, 2.0, 3.2),
    (3.0, 2.0, 2.4),
    (2.0, 1.5, 2.4),
)
"""Random turns (degrees), random shifts (mm) and voxel size (mm) of the rounds of placing runs again."""


MIN_ROUNDS = 2

WIDE_REFINEMENT = ((12.0, 5.0), (8.0, 4.0))
"""Random turns (degrees) and shifts (mm) after a search of the whole sphere."""

IN_PLACE = 0.75
"""Held-out correlation of a stack above which it is not searched for elsewhere: stacks that lie the wrong way
reach 0.65, stacks in place 0.7 to 0.9."""

MARGIN = 100.0
"""A stack's slices get motions of their own, or leave where a hypothesis put them, only for a cost (logarithm
of odds) lower by at least this. Runs that fit noise gain 10 to 30, a single true jerk several hundred."""


@dataclass(frozen=True)
class HeldOutScore:
    """How well every stack is predicted by the others.

    Args:
        prediction: one for each stack.
    """

    prediction: list[Prediction]

    @property
    def cost(self) -> float:
        """Sum over the stacks."""
        return sum(p.cost for p in self.prediction)


def held_out_score(slices: Slices, samples: list[StackSamples], motion: RigidPose) -> HeldOutScore:
    """Leave each stack out in turn and compare it with the volume of the others.

    Args:
        slices: of two or more stacks.
        samples: the same, as a search sees them.
        motion: [K] world from header of all slices.
    """
    posed = moved(slices, motion)
    found = []
    for sample in samples:
        volume, grid = volume_without(posed, sample.stack, HELD_OUT_VOXEL_MM)
        own = motion.take(sample.rows)
        found.append(predict(sample, own, volume, grid, estimate_interleave(sample, own)))
    return HeldOutScore(found)


def estimate_interleave(sample: StackSamples, motion: RigidPose) -> int:
    """The acquisition order under which a stack's motions [K] change least."""
    penalties = {
        n: transition_penalty(changes_in_time(motion, sample.slice_index, sample.pixels.center_mm, n))
        for n in time_orders(sample.slice_index)
    }
    return min(penalties, key=lambda n: penalties[n])


def moved(slices: Slices, motion: RigidPose) -> Slices:
    """The slices at motions [K] (world from header)."""
    return slices.with_pose(motion @ slices.header_pose)


def best_initialisation(
    slices: Slices, samples: list[StackSamples], initialisations: Mapping[str, RigidPose]
) -> tuple[str, dict[str, HeldOutScore]]:
    """The name of the hypothesis with the least held-out cost, and how all of them did.

    Args:
        slices: of two or more stacks.
        samples: the same, as a search sees them.
        initialisations: motions [K] (world from header) by name.
    """
    judged = {name: held_out_score(slices, samples, motion) for name, motion in initialisations.items()}
    for name, judgement in judged.items():
        logger.info(
            "%s: held-out cost %.0f, correlation %s",
            name,
            judgement.cost,
            " ".join(f"{p.correlation:.2f}" for p in judgement.prediction),
        )
    return min(judged, key=lambda name: judged[name].cost), judged


def aligned_to(slices: Slices, motion: RigidPose, other: RigidPose) -> RigidPose:
    """Motions `other` [K], brought by one common motion as near as possible to `motion` [K].

    Robust: slices that the two place differently hardly count.
    """
    corners = slices.planes.corners_mm()
    here = (motion @ slices.header_pose).apply(corners).reshape(-1, 3)
    there = (other @ slices.header_pose).apply(corners).reshape(-1, 3)
    common, _ = fit_rigid_robust(there, here, scale_mm=5.0, n_rounds=15)
    return common @ other


def refine_segments(
    slices: Slices,
    samples: list[StackSamples],
    motion: RigidPose,
    others: list[RigidPose],
    rng: np.random.Generator,
    deadline: Deadline | None = None,
) -> tuple[RigidPose, list[Placement]]:
    """Place the runs of every stack again and again in the volume of the other stacks.

    Args:
        slices: of two or more stacks.
        samples: the same, as a search sees them.
        motion: [K] world from header, to start from.
        others: rival motions [K] in the same frame, offered in the first round.
        rng: source of randomness.
        deadline: fewer rounds if they would end after it.

    Returns:
        Motions [K], and the last placement of each stack.
    """
    placements: list[Placement] = []
    for sample in samples:
        motion = with_rows(motion, sample.rows, _searched_widely(slices, sample, motion, rng))
    for number, done in timed_steps(len(ROUNDS), deadline, least=MIN_ROUNDS):
        rotation_deg, translation_mm, voxel_mm = ROUNDS[int(round(done * len(ROUNDS), 9))]
        placements = []
        for sample in samples:
            volume, grid = volume_without(moved(slices, motion), sample.stack, voxel_mm)
            rival = _stacked([other.take(sample.rows) for other in others]) if number == 0 else None
            one = refine_placement(
                sample,
                motion.take(sample.rows),
                volume,
                grid,
                rotation_deg=rotation_deg,
                translation_mm=translation_mm,
                rng=rng,
                proposals=rival,
            )
            motion = with_rows(motion, sample.rows, one.motion)
            placements.append(one)
    return motion, placements


def _searched_widely(slices: Slices, sample: StackSamples, motion: RigidPose, rng: np.random.Generator) -> RigidPose:
    """Motions [K] of a stack: its own, or better ones from anywhere on the sphere.

    A stack whose start lies upside down cannot come back by small steps.
    """
    posed = moved(slices, motion)
    volume, grid = volume_without(posed, sample.stack, HELD_OUT_VOXEL_MM)
    others = posed.take(posed.stack_id != sample.stack)
    target = others.planes.pixel_world_mm(others.pixel_index).mean(0)
    best = motion.take(sample.rows)
    present = predict(sample, best, volume, grid, estimate_interleave(sample, best))
    if present.correlation > IN_PLACE:
        return best
    cost = present.cost
    for base in stack_orientations(sample, target, volume, grid):
        found = place_around(sample, base, target, volume, grid)
        for rotation_deg, translation_mm in WIDE_REFINEMENT:
            found = refine_placement(
                sample, found.motion, volume, grid, rotation_deg=rotation_deg, translation_mm=translation_mm, rng=rng
            )
        new = predict(sample, found.motion, volume, grid, found.segments.interleave).cost
        logger.debug("stack %d: present place costs %.0f, another %.0f", sample.stack, cost, new)
        if new < cost:
            best, cost = found.motion, new
    return best


def collapse_to_rigid(
    slices: Slices, samples: list[StackSamples], motion: RigidPose, interleave: list[int]
) -> tuple[RigidPose, list[bool]]:
    """Give a stack one motion for all its slices where that predicts them as well.

    Returns:
        Motions [K], and for each stack whether its slices now share one.
    """
    shared = []
    for sample, order in zip(samples, interleave, strict=True):
        posed = moved(slices, motion)
        volume, grid = volume_without(posed, sample.stack, 2.4)
        own, is_one = one_motion_or_segments(slices, sample, motion.take(sample.rows), order, volume, grid)
        motion = with_rows(motion, sample.rows, own)
        shared.append(is_one)
    return motion, shared


def one_motion_or_segments(
    slices: Slices,
    sample: StackSamples,
    motion: RigidPose,
    interleave: int,
    volume: NDArray[np.float32],
    grid: VolumeGrid,
    margin: float = MARGIN,
) -> tuple[RigidPose, bool]:
    """One motion for all slices of a stack where a volume predicts them as well by it; otherwise its runs.

    Args:
        slices: of all stacks.
        sample: the stack.
        motion: [K] of its slices (world from header), in runs.
        interleave: its acquisition order.
        volume: [I, J, K] that the stack did not help to make.
        grid: its grid.
        margin: by how much runs have to be cheaper.

    Returns:
        Motions [K], and whether they are all one.
    """
    rigid = _one_motion(slices.take(sample.rows), motion, volume, grid)
    free = predict(sample, motion, volume, grid, interleave)
    still = predict(sample, rigid, volume, grid, interleave)
    is_one = still.cost <= free.cost + margin
    logger.debug("stack %d: one motion costs %.0f, runs %.0f", sample.stack, still.cost, free.cost)
    return (rigid, True) if is_one else (motion, False)


def _one_motion(stack: Slices, motion: RigidPose, volume: NDArray[np.float32], grid: VolumeGrid) -> RigidPose:
    """The best single motion [K, all alike] near motions [K]."""
    identity = RigidPose.identity(len(stack))
    mean = aligned_to(stack, motion, identity)
    model = SliceModel(stack, volume, grid, stride=max(1, len(stack.pixel_index) // 15_000), psf_points=3)
    pose = refine_stack(model, stack, mean @ stack.header_pose, n_steps=10)
    return pose @ stack.header_pose.inverse()


def with_rows(motion: RigidPose, rows: NDArray[np.int64], new: RigidPose) -> RigidPose:
    """Motions [K] with those of some rows replaced."""
    rotation, translation = motion.rotation.copy(), motion.translation_mm.copy()
    rotation[rows], translation[rows] = new.rotation, new.translation_mm
    return RigidPose(rotation, translation)


def _stacked(motions: list[RigidPose]) -> RigidPose | None:
    if not motions:
        return None
    return RigidPose(np.concatenate([m.rotation for m in motions]), np.concatenate([m.translation_mm for m in motions]))
