"""Rival ideas of how the slices lie, and which of them predicts slices that it has not seen."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import fit_rigid
from g3r.registration.normal_equations import SliceModel
from g3r.registration.placement import (
    Placement,
    Prediction,
    StackPixels,
    place_again,
    predict,
    volume_without,
)
from g3r.registration.segments import changes_in_time, price_of_changes, time_orders
from g3r.registration.so3_search import place_around, stack_orientations
from g3r.registration.stack_registration import refine_stack
from g3r.run.deadline import Deadline, paced

logger = logging.getLogger(__name__)

HELD_OUT_VOXEL_MM = 3.2

ROUNDS = (
    (8.0, 4.0, 3.2), (8.0, 4.0, 3.2), (5.0, 3.0, 3.2), (5.0, 3.0, 3.2), (3.0, 2.0, 3.2), (3.0, 2.0, 2.4),
    (2.0, 1.5, 2.4),
)  # fmt: skip
"""Random turns (degrees), random shifts (mm) and voxel size (mm) of the rounds of placing runs again."""


LEAST_ROUNDS = 2

WIDE_REFINEMENT = ((12.0, 5.0), (8.0, 4.0))
"""Random turns (degrees) and shifts (mm) after a search of the whole sphere."""

IN_PLACE = 0.75
"""Held-out correlation of a stack above which it is not searched for elsewhere: stacks that lie the wrong way
reach 0.65, stacks in place 0.7 to 0.9."""

MARGIN = 100.0
"""A stack's slices get motions of their own, or leave where a hypothesis put them, only for a cost (logarithm
of odds) lower by at least this. Runs that fit noise gain 10 to 30, a single true jerk several hundred."""


@dataclass(frozen=True)
class Judgement:
    """How well every stack is predicted by the others.

    Args:
        prediction: one for each stack.
    """

    prediction: list[Prediction]

    @property
    def cost(self) -> float:
        """Sum over the stacks."""
        return sum(p.cost for p in self.prediction)


def judge(slices: Slices, parts: list[StackPixels], motion: RigidPose) -> Judgement:
    """Leave each stack out in turn and compare it with the volume of the others.

    Args:
        slices: of two or more stacks.
        parts: the same, as a search sees them.
        motion: [K] world from header of all slices.
    """
    posed = moved(slices, motion)
    found = []
    for part in parts:
        volume, grid = volume_without(posed, part.stack, HELD_OUT_VOXEL_MM)
        own = motion.take(part.rows)
        found.append(predict(part, own, volume, grid, calmest_interleave(part, own)))
    return Judgement(found)


def calmest_interleave(part: StackPixels, motion: RigidPose) -> int:
    """The acquisition order under which a stack's motions [K] change least."""
    prices = {
        n: price_of_changes(changes_in_time(motion, part.slice_index, part.pixels.center_mm, n))
        for n in time_orders(part.slice_index)
    }
    return min(prices, key=lambda n: prices[n])


def moved(slices: Slices, motion: RigidPose) -> Slices:
    """The slices at motions [K] (world from header)."""
    return slices.with_pose(motion @ slices.header_pose)


def choose(
    slices: Slices, parts: list[StackPixels], hypotheses: Mapping[str, RigidPose]
) -> tuple[str, dict[str, Judgement]]:
    """The name of the hypothesis with the least held-out cost, and how all of them did.

    Args:
        slices: of two or more stacks.
        parts: the same, as a search sees them.
        hypotheses: motions [K] (world from header) by name.
    """
    judged = {name: judge(slices, parts, motion) for name, motion in hypotheses.items()}
    for name, judgement in judged.items():
        logger.info(
            "%s: held-out cost %.0f, correlation %s", name, judgement.cost,
            " ".join(f"{p.correlation:.2f}" for p in judgement.prediction),
        )  # fmt: skip
    return min(judged, key=lambda name: judged[name].cost), judged


def in_frame_of(slices: Slices, motion: RigidPose, other: RigidPose) -> RigidPose:
    """Motions `other` [K], brought by one common motion as near as possible to `motion` [K].

    Robust: slices that the two place differently hardly count.
    """
    corners = _corners(slices)
    here = (motion @ slices.header_pose).apply(corners).reshape(-1, 3)
    there = (other @ slices.header_pose).apply(corners).reshape(-1, 3)
    weight = np.ones(len(here))
    for _ in range(15):
        common = fit_rigid(there, here, weight)
        away_mm = np.linalg.norm(common.apply(there[None])[0] - here, axis=1)
        weight = 1 / (1 + (away_mm / 5.0) ** 2)
    return common @ other


def _corners(slices: Slices) -> NDArray[np.float64]:
    size_mm = slices.planes.shape * slices.planes.spacing_mm
    unit = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])
    return np.pad(size_mm[:, None, :] * unit, ((0, 0), (0, 0), (0, 1)))


def settle(
    slices: Slices,
    parts: list[StackPixels],
    motion: RigidPose,
    others: list[RigidPose],
    rng: np.random.Generator,
    deadline: Deadline | None = None,
) -> tuple[RigidPose, list[Placement]]:
    """Place the runs of every stack again and again in the volume of the other stacks.

    Args:
        slices: of two or more stacks.
        parts: the same, as a search sees them.
        motion: [K] world from header, to start from.
        others: rival motions [K] in the same frame, offered in the first round.
        rng: source of randomness.
        deadline: fewer rounds if they would end after it.

    Returns:
        Motions [K], and the last placement of each stack.
    """
    placements: list[Placement] = []
    for part in parts:
        motion = put(motion, part.rows, _searched_widely(slices, part, motion, rng))
    for number, done in paced(len(ROUNDS), deadline, least=LEAST_ROUNDS):
        turn_deg, shift_mm, voxel_mm = ROUNDS[int(round(done * len(ROUNDS), 9))]
        placements = []
        for part in parts:
            volume, grid = volume_without(moved(slices, motion), part.stack, voxel_mm)
            rival = _stacked([other.take(part.rows) for other in others]) if number == 0 else None
            one = place_again(
                part, motion.take(part.rows), volume, grid,
                turn_deg=turn_deg, shift_mm=shift_mm, rng=rng, proposals=rival,
            )  # fmt: skip
            motion = put(motion, part.rows, one.motion)
            placements.append(one)
    return motion, placements


def _searched_widely(
    slices: Slices, part: StackPixels, motion: RigidPose, rng: np.random.Generator
) -> RigidPose:
    """Motions [K] of a stack: its own, or better ones from anywhere on the sphere.

    A stack whose start lies upside down cannot come back by small steps.
    """
    posed = moved(slices, motion)
    volume, grid = volume_without(posed, part.stack, HELD_OUT_VOXEL_MM)
    others = posed.take(posed.stack_id != part.stack)
    target = others.planes.pixel_world_mm(others.pixel_index).mean(0)
    best = motion.take(part.rows)
    present = predict(part, best, volume, grid, calmest_interleave(part, best))
    if present.correlation > IN_PLACE:
        return best
    cost = present.cost
    for base in stack_orientations(part, target, volume, grid):
        found = place_around(part, base, target, volume, grid)
        for turn_deg, shift_mm in WIDE_REFINEMENT:
            found = place_again(
                part, found.motion, volume, grid, turn_deg=turn_deg, shift_mm=shift_mm, rng=rng
            )
        new = predict(part, found.motion, volume, grid, found.runs.interleave).cost
        logger.debug("stack %d: present place costs %.0f, another %.0f", part.stack, cost, new)
        if new < cost:
            best, cost = found.motion, new
    return best


def simplify(
    slices: Slices, parts: list[StackPixels], motion: RigidPose, interleave: list[int]
) -> tuple[RigidPose, list[bool]]:
    """Give a stack one motion for all its slices where that predicts them as well.

    Returns:
        Motions [K], and for each stack whether its slices now share one.
    """
    shared = []
    for part, order in zip(parts, interleave, strict=True):
        posed = moved(slices, motion)
        volume, grid = volume_without(posed, part.stack, 2.4)
        own, is_one = one_motion_or_runs(slices, part, motion.take(part.rows), order, volume, grid)
        motion = put(motion, part.rows, own)
        shared.append(is_one)
    return motion, shared


def one_motion_or_runs(
    slices: Slices,
    part: StackPixels,
    motion: RigidPose,
    interleave: int,
    volume: NDArray[np.float32],
    grid: VolumeGrid,
    margin: float = MARGIN,
) -> tuple[RigidPose, bool]:
    """One motion for all slices of a stack where a volume predicts them as well by it; otherwise its runs.

    Args:
        slices: of all stacks.
        part: the stack.
        motion: [K] of its slices (world from header), in runs.
        interleave: its acquisition order.
        volume: [I, J, K] that the stack did not help to make.
        grid: its grid.
        margin: by how much runs have to be cheaper.

    Returns:
        Motions [K], and whether they are all one.
    """
    rigid = _one_motion(slices.take(part.rows), motion, volume, grid)
    free = predict(part, motion, volume, grid, interleave)
    still = predict(part, rigid, volume, grid, interleave)
    is_one = still.cost <= free.cost + margin
    logger.debug("stack %d: one motion costs %.0f, runs %.0f", part.stack, still.cost, free.cost)
    return (rigid, True) if is_one else (motion, False)


def _one_motion(stack: Slices, motion: RigidPose, volume: NDArray[np.float32], grid: VolumeGrid) -> RigidPose:
    """The best single motion [K, all alike] near motions [K]."""
    identity = RigidPose.identity(len(stack))
    mean = in_frame_of(stack, motion, identity)
    model = SliceModel(stack, volume, grid, stride=max(1, len(stack.pixel_index) // 15_000), psf_points=3)
    pose = refine_stack(model, stack, mean @ stack.header_pose, n_steps=10)
    return pose @ stack.header_pose.inverse()


def put(motion: RigidPose, rows: NDArray[np.int64], new: RigidPose) -> RigidPose:
    """Motions [K] with those of some rows replaced."""
    rotation, translation = motion.rotation.copy(), motion.translation_mm.copy()
    rotation[rows], translation[rows] = new.rotation, new.translation_mm
    return RigidPose(rotation, translation)


def _stacked(motions: list[RigidPose]) -> RigidPose | None:
    if not motions:
        return None
    return RigidPose(
        np.concatenate([m.rotation for m in motions]), np.concatenate([m.translation_mm for m in motions])
    )
