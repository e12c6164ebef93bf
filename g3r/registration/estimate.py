"""Motion of every slice: rival hypotheses, runs between jerks, then each slice for itself, coarse to fine."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import Orientation, centred_on_headers, standard_orientation
from g3r.registration.bias_correction import flattened
from g3r.registration.candidates import calmest_interleave, in_frame_of, judge, moved, put
from g3r.registration.global_search import search, search_single
from g3r.registration.placement import StackPixels
from g3r.registration.segments import SAME_PLACE_MM, changes_in_time
from g3r.registration.settings import MotionSettings
from g3r.registration.slice_rounds import FittedSlices, SliceRounds, correlation_with_all, refine_slices
from g3r.registration.template_search import template_fits
from g3r.run.deadline import Deadline

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MotionEstimate:
    """Slices in estimated poses with gain [K], trust [K] in (0, 1] and correlation [K] with the volume.

    Args:
        slices: in the frame of the result.
        gain, weight, ncc: see above.
        held_out: for each stack the correlation with a volume made of the other stacks, outline included;
            None for a single stack.
        hypothesis: where the search started.
        hypotheses: held-out correlation of every hypothesis, stack by stack.
        interleave: of each stack, as its motion suggests; None where it lay still, which suggests nothing.
        n_runs: of each stack, between jerks; 1 where it lay still.
        orientation: how the result was turned; None where it stays in scanner space.
        history: one line of figures a round.
    """

    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    held_out: list[float] | None
    hypothesis: str
    hypotheses: dict[str, list[float]]
    interleave: list[int | None]
    n_runs: list[int]
    orientation: Orientation | None
    history: list[dict[str, float]] = field(default_factory=list)


def estimate_motion(
    slices: Slices,
    settings: MotionSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    template: AtlasTemplate | None = None,
    proposals: Mapping[str, RigidPose] | None = None,
    deadline: Deadline | None = None,
) -> MotionEstimate:
    """Poses of all slices, from their header poses.

    Args:
        slices: intensities of order one (the 99th percentile near 1), at their header poses.
        settings: which layers, and how long.
        progress: called with (rounds done, rounds in all).
        template: mean heads; None leaves that layer out.
        proposals: motions [K] (world from header) by other means, such as the pose network, by name.
        deadline: registration shortens its search and its rounds to end by then, if it can.
    """
    given = slices
    if settings.flatten:
        slices = flattened(slices)
    parts = StackPixels.of_all(slices, settings.n_candidates)
    single = len(parts) == 1
    if template is not None and not (settings.template and template_fits(slices, template)):
        template = None
    if single:
        found = search_single(slices, parts[0], settings, template)
    else:
        by_then = deadline.part(SEARCH_SHARE) if deadline else None
        found = search(slices, parts, settings, template, proposals or {}, by_then)
    motion, placed = found.motion, found.placed
    n_runs, interleave = _runs_of(parts, motion)
    posed = moved(slices, motion)
    rounds = SliceRounds(
        0 if single else settings.n_rounds, settings.steps_per_round, settings.finest_voxel_mm,
        settings.pixels_at_most,
    )  # fmt: skip
    fitted = refine_slices(posed, rounds, progress, deadline.part(ROUNDS_SHARE) if deadline else None)
    held_out = None
    if not single:
        still = [part.stack for part, n in zip(parts, n_runs, strict=True) if n == 1]
        fitted, held_out = _kept_where_better(slices, parts, still, motion, fitted, settings.finest_voxel_mm)
    orientation = None
    if placed is not None and settings.standard_orientation:
        start = placed.motion(len(slices), parts)
        rng = np.random.default_rng(settings.seed)
        orientation = standard_orientation(fitted.slices, placed.heads, start, rng)
    pose = centred_on_headers(fitted.slices).planes.pose if orientation is None else orientation.pose
    result = given.with_pose(pose)
    return MotionEstimate(
        result, fitted.gain, fitted.weight, fitted.ncc, held_out, found.hypothesis, found.hypotheses,
        interleave, n_runs, orientation, fitted.history,
    )  # fmt: skip


SEARCH_SHARE, ROUNDS_SHARE = 0.6, 0.7
"""Of the time that there is, how much the search may take; and of what is left then, how much the rounds may.
The rest is for the judgement of stacks that lay still and for the orientation."""

LARGEST_LOSS = 0.02
"""A still stack whose held-out correlation falls by more than this as its slices move goes back in line."""

LEAST_GAIN_NCC = 0.015
"""... and so does one whose slices correlate better with the volume of all by less than this, in the median:
0.004 to 0.010 where nothing moved (they fit noise), 0.02 to 0.05 with mild motion."""


def _kept_where_better(
    slices: Slices,
    parts: list[StackPixels],
    still: list[int],
    motion: RigidPose,
    fitted: FittedSlices,
    voxel_mm: float,
) -> tuple[FittedSlices, list[float]]:
    """The fitted slices, still stacks that lost by it back in line, and held-out correlations of all.

    Small and thick slices fit noise, and where nothing moved there is nothing to gain. Stacks that did move
    are not asked: a few slices that went astray lower their correlation, while all others gain.
    """
    before = judge(slices, parts, motion)
    refined = fitted.slices.world_from_header()
    equal = np.ones(len(slices))
    in_line = correlation_with_all(moved(slices, motion), equal, equal, voxel_mm)
    after = judge(slices, parts, refined)
    lost = [
        part
        for part, old, new in zip(parts, before.prediction, after.prediction, strict=True)
        if part.stack in still
        and (
            new.correlation < old.correlation - LARGEST_LOSS
            or np.median(fitted.ncc[part.rows]) < np.median(in_line[part.rows]) + LEAST_GAIN_NCC
        )
    ]
    if not lost:
        return fitted, [p.correlation for p in after.prediction]
    # the refined slices as a whole may have drifted from the runs; stacks that go back must follow
    motion = in_frame_of(slices, refined, motion)
    gain, weight = fitted.gain.copy(), fitted.weight.copy()
    for part in lost:
        logger.info("stack %d: slices go back in line", part.stack)
        refined = put(refined, part.rows, motion.take(part.rows))
        gain[part.rows], weight[part.rows] = 1.0, 1.0  # what the refined poses said of them
    final = judge(slices, parts, refined)
    kept = replace(fitted, slices=moved(slices, refined), gain=gain, weight=weight)
    return kept, [p.correlation for p in final.prediction]


def _runs_of(parts: list[StackPixels], motion: RigidPose) -> tuple[list[int], list[int | None]]:
    """Number of runs of each stack, and the acquisition order under which they are fewest."""
    n_runs, interleave = [], list[int | None]()
    for part in parts:
        own = motion.take(part.rows)
        order = calmest_interleave(part, own)
        moves = changes_in_time(own, part.slice_index, part.pixels.center_mm, order)
        n_runs.append(1 + int((moves > SAME_PLACE_MM).sum()))
        interleave.append(order if n_runs[-1] > 1 else None)
    return n_runs, interleave
