"""Search for the motion segments of all stacks: each stack is placed repeatedly in the volume of the others."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.atlas_template import PlacedHead
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose, VolumeGrid
from g3r.geometry.rigid import fit_rigid_robust
from g3r.registration.held_out import HELD_OUT_VOXEL_MM, HeldOutScore, held_out_score, predict, volume_without
from g3r.registration.motion_segments import estimate_interleave
from g3r.registration.normal_equations import SampledSlices
from g3r.registration.placement import Placement, refine_placement
from g3r.registration.similarity import StackSamples
from g3r.registration.so3_search import place_around, stack_orientations
from g3r.registration.stack_registration import refine_stack
from g3r.registration.thresholds import IN_PLACE_CORRELATION, MIN_COST_GAIN
from g3r.run.deadline import Deadline, timed_steps

logger = logging.getLogger(__name__)

ROUNDS = (
    (8.0, 4.0, 3.2),
    (8.0, 4.0, 3.2),
    (5.0, 3.0, 3.2),
    (5.0, 3.0, 3.2),
    (3.0, 2.0, 3.2),
    (3.0, 2.0, 2.4),
    (2.0, 1.5, 2.4),
)
"""Standard deviations of random rotations (degrees) and translations (mm), and voxel size (mm), round by round."""

MIN_ROUNDS = 2

WIDE_REFINEMENT = ((12.0, 5.0), (8.0, 4.0))
"""Random rotations (degrees) and translations (mm) after an exhaustive search of orientations."""

RIGID_VOXEL_MM = 2.4


def aligned_to(slices: Slices, motion: RigidPose, other: RigidPose) -> RigidPose:
    """Another set of motions, aligned to the first by one common rigid motion.

    The fit is robust: slices that the two sets place differently hardly count.

    Args:
        slices: K slices.
        motion: [K] world from header.
        other: [K] world from header, in another frame.
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
    fill: PlacedHead | None = None,
    known: HeldOutScore | None = None,
) -> tuple[RigidPose, list[Placement]]:
    """Place the motion segments of every stack in the volume of the other stacks, round after round.

    Args:
        slices: of two or more stacks.
        samples: the thinned pixels of each stack.
        motion: [K] world from header, to start from.
        others: motions [K] of other initialisations in the same frame, candidates in the first round.
        rng: source of randomness.
        deadline: fewer rounds if they would end after it.
        fill: see `volume_without`.
        known: the score of the motions to start from; found here when None.

    Returns:
        Motions [K], and the last placement of each stack.
    """
    placements: list[Placement] = []
    known = known or held_out_score(slices, samples, motion, fill)
    as_scored = True
    for sample, prediction in zip(samples, known.prediction, strict=True):
        if as_scored and prediction.correlation > IN_PLACE_CORRELATION:
            continue
        found = _search_orientations(slices, sample, motion, rng, fill)
        as_scored = as_scored and found is None
        if found is not None:
            motion = motion.with_rows(sample.rows, found)
    for number, done in timed_steps(len(ROUNDS), deadline, least=MIN_ROUNDS):
        rotation_deg, translation_mm, voxel_mm = ROUNDS[int(round(done * len(ROUNDS), 9))]
        placements = []
        for sample in samples:
            volume, grid = volume_without(slices.with_motion(motion), sample.stack, voxel_mm, fill)
            proposals = None
            if number == 0 and others:
                proposals = RigidPose.concatenated([other.take(sample.rows) for other in others])
            placement = refine_placement(
                sample,
                motion.take(sample.rows),
                volume,
                grid,
                rotation_deg=rotation_deg,
                translation_mm=translation_mm,
                rng=rng,
                proposals=proposals,
            )
            motion = motion.with_rows(sample.rows, placement.motion)
            placements.append(placement)
    return motion, placements


def _search_orientations(
    slices: Slices, sample: StackSamples, motion: RigidPose, rng: np.random.Generator, fill: PlacedHead | None
) -> RigidPose | None:
    """Better motions [K] of one stack than the present ones, from an exhaustive search; None if there are none.

    A stack that starts upside down cannot come back by small steps.
    """
    posed = slices.with_motion(motion)
    volume, grid = volume_without(posed, sample.stack, HELD_OUT_VOXEL_MM, fill)
    others = posed.take(posed.stack_id != sample.stack)
    target = others.planes.pixel_world_mm(others.pixel_index).mean(0)
    if fill is not None:  # the others' pixels may lie at one side of the head
        target = fill.center_mm
    own = motion.take(sample.rows)
    interleave = estimate_interleave(own, sample.slice_index, sample.pixels.center_mm)
    present = predict(sample, own, volume, grid, interleave)
    if present.correlation > IN_PLACE_CORRELATION:
        return None
    best, cost = None, present.cost
    for base in stack_orientations(sample, target, volume, grid):
        found = place_around(sample, base, target, volume, grid)
        for rotation_deg, translation_mm in WIDE_REFINEMENT:
            found = refine_placement(
                sample, found.motion, volume, grid, rotation_deg=rotation_deg, translation_mm=translation_mm, rng=rng
            )
        new_cost = predict(sample, found.motion, volume, grid, found.segments.interleave).cost
        logger.debug("stack %d: cost %.0f, at another orientation %.0f", sample.stack, cost, new_cost)
        if new_cost < cost:
            best, cost = found.motion, new_cost
    return best


def collapse_to_rigid(
    slices: Slices,
    samples: list[StackSamples],
    motion: RigidPose,
    interleave: list[int],
    fill: PlacedHead | None = None,
) -> RigidPose:
    """Motions [K] with one motion for all slices of a stack where that predicts the stack as well.

    Args:
        slices: of two or more stacks.
        samples: the thinned pixels of each stack.
        motion: [K] world from header, in segments.
        interleave: acquisition order of each stack.
        fill: see `volume_without`.
    """
    for sample, order in zip(samples, interleave, strict=True):
        volume, grid = volume_without(slices.with_motion(motion), sample.stack, RIGID_VOXEL_MM, fill)
        own, _ = rigid_or_segments(slices, sample, motion.take(sample.rows), order, volume, grid)
        motion = motion.with_rows(sample.rows, own)
    return motion


def rigid_or_segments(
    slices: Slices,
    sample: StackSamples,
    motion: RigidPose,
    interleave: int,
    volume: NDArray[np.float32],
    grid: VolumeGrid,
    *,
    min_cost_gain: float = MIN_COST_GAIN,
    min_correlation: float = -1.0,
) -> tuple[RigidPose, bool]:
    """One motion for all slices of a stack, if a volume predicts them as well with it; else its segments.

    Args:
        slices: of all stacks.
        sample: the stack.
        motion: [K] of its slices (world from header), in segments.
        interleave: its acquisition order.
        volume: [I, J, K] made without the stack.
        grid: its grid.
        min_cost_gain: by how much segments have to be cheaper.
        min_correlation: least correlation of segments with the volume.

    Returns:
        Motions [K], and whether they are all the same.
    """
    rigid = _rigid_motion(slices.take(sample.rows), motion, volume, grid)
    in_segments = predict(sample, motion, volume, grid, interleave)
    in_one = predict(sample, rigid, volume, grid, interleave)
    is_rigid = in_one.cost <= in_segments.cost + min_cost_gain or in_segments.correlation < min_correlation
    logger.debug("stack %d: cost %.0f as one, %.0f in segments", sample.stack, in_one.cost, in_segments.cost)
    return (rigid, True) if is_rigid else (motion, False)


def _rigid_motion(stack: Slices, motion: RigidPose, volume: NDArray[np.float32], grid: VolumeGrid) -> RigidPose:
    """The best single motion [K, all the same] near motions [K]."""
    identity = RigidPose.identity(len(stack))
    mean = aligned_to(stack, motion, identity)
    model = SampledSlices(stack, volume, grid, n_pixels=15_000, psf_points=3)
    pose = refine_stack(model, stack, mean @ stack.header_pose, n_steps=10)
    return pose @ stack.header_pose.inverse()
