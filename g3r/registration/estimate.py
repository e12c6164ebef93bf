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
from g3r.registration.bias_correction import bias_corrected
from g3r.registration.candidates import aligned_to, estimate_interleave, held_out_score, moved, with_rows
from g3r.registration.global_search import search, search_single
from g3r.registration.placement import StackSamples
from g3r.registration.segments import SAME_PLACE_MM, changes_in_time
from g3r.registration.settings import RegistrationSettings
from g3r.registration.slice_rounds import FittedSlices, SliceRounds, correlation_with_all, refine_slices
from g3r.registration.template_search import template_fits
from g3r.run.deadline import Deadline

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Registration:
    """Slices in estimated poses with gain [K], trust [K] in (0, 1] and correlation [K] with the volume.

    Args:
        slices: in the frame of the result.
        gain, weight, ncc: see above.
        held_out: for each stack the correlation with a volume made of the other stacks, outline included;
            None for a single stack.
        initialisation: where the search started.
        initialisations: held-out correlation of every hypothesis, stack by stack.
        interleave: of each stack, as its motion suggests; None where it lay still, which suggests nothing.
        n_segments: of each stack, between jerks; 1 where it lay still.
        orientation: how the result was turned; None where it stays in scanner space.
        history: one line of figures a round.
    """

    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    held_out: list[float] | None
    initialisation: str
    initialisations: dict[str, list[float]]
    interleave: list[int | None]
    n_segments: list[int]
    orientation: Orientation | None
    history: list[dict[str, float]] = field(default_factory=list)


def register(
    slices: Slices,
    settings: RegistrationSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    template: AtlasTemplate | None = None,
    proposals: Mapping[str, RigidPose] | None = None,
    deadline: Deadline | None = None,
) -> Registration:
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
    if settings.bias_correction:
        slices = bias_corrected(slices)
    samples = StackSamples.of_all(slices, settings.n_candidates)
    single = len(samples) == 1
    if template is not None and not (settings.template and template_fits(slices, template)):
        template = None
    if single:
        found = search_single(slices, samples[0], settings, template)
    else:
        by_then = deadline.part(SEARCH_SHARE) if deadline else None
        found = search(slices, samples, settings, template, proposals or {}, by_then)
    motion, placed = found.motion, found.placed
    n_segments, interleave = _segments_of(samples, motion)
    posed = moved(slices, motion)
    rounds = SliceRounds(
        0 if single else settings.n_rounds, settings.steps_per_round, settings.finest_voxel_mm, settings.max_pixels
    )
    fitted = refine_slices(posed, rounds, progress, deadline.part(ROUNDS_SHARE) if deadline else None)
    held_out = None
    if not single:
        still = [sample.stack for sample, n in zip(samples, n_segments, strict=True) if n == 1]
        fitted, held_out = _kept_where_better(slices, samples, still, motion, fitted, settings.finest_voxel_mm)
    orientation = None
    if placed is not None and settings.standard_orientation:
        start = placed.motion(len(slices), samples)
        rng = np.random.default_rng(settings.seed)
        orientation = standard_orientation(fitted.slices, placed.heads, start, rng)
    pose = centred_on_headers(fitted.slices).planes.pose if orientation is None else orientation.pose
    result = given.with_pose(pose)
    return Registration(
        result,
        fitted.gain,
        fitted.weight,
        fitted.ncc,
        held_out,
        found.initialisation,
        found.initialisations,
        interleave,
        n_segments,
        orientation,
        fitted.history,
    )


SEARCH_SHARE, ROUNDS_SHARE = 0.6, 0.7
"""Of the time that there is, how much the search may take; and of what is left then, how much the rounds may.
The rest is for the judgement of stacks that lay still and for the orientation."""

MAX_LOSS = 0.02
"""A still stack whose held-out correlation falls by more than this as its slices move goes back in line."""

MIN_GAIN_NCC = 0.015
"""... and so does one whose slices correlate better with the volume of all by less than this, in the median:
0.004 to 0.010 where nothing moved (they fit noise), 0.02 to 0.05 with mild motion."""


def _kept_where_better(
    slices: Slices,
    samples: list[StackSamples],
    still: list[int],
    motion: RigidPose,
    fitted: FittedSlices,
    voxel_mm: float,
) -> tuple[FittedSlices, list[float]]:
    """The fitted slices, still stacks that lost by it back in line, and held-out correlations of all.

    Small and thick slices fit noise, and where nothing moved there is nothing to gain. Stacks that did move
    are not asked: a few slices that went astray lower their correlation, while all others gain.
    """
    before = held_out_score(slices, samples, motion)
    refined = fitted.slices.world_from_header()
    equal = np.ones(len(slices))
    rigid_stack = correlation_with_all(moved(slices, motion), equal, equal, voxel_mm)
    after = held_out_score(slices, samples, refined)
    lost = [
        sample
        for sample, old, new in zip(samples, before.prediction, after.prediction, strict=True)
        if sample.stack in still
        and (
            new.correlation < old.correlation - MAX_LOSS
            or np.median(fitted.ncc[sample.rows]) < np.median(rigid_stack[sample.rows]) + MIN_GAIN_NCC
        )
    ]
    if not lost:
        return fitted, [p.correlation for p in after.prediction]
    # the refined slices as a whole may have drifted from the runs; stacks that go back must follow
    motion = aligned_to(slices, refined, motion)
    gain, weight = fitted.gain.copy(), fitted.weight.copy()
    for sample in lost:
        logger.info("stack %d: slices go back in line", sample.stack)
        refined = with_rows(refined, sample.rows, motion.take(sample.rows))
        gain[sample.rows], weight[sample.rows] = 1.0, 1.0  # what the refined poses said of them
    final = held_out_score(slices, samples, refined)
    kept = replace(fitted, slices=moved(slices, refined), gain=gain, weight=weight)
    return kept, [p.correlation for p in final.prediction]


def _segments_of(samples: list[StackSamples], motion: RigidPose) -> tuple[list[int], list[int | None]]:
    """Number of runs of each stack, and the acquisition order under which they are fewest."""
    n_segments, interleave = [], list[int | None]()
    for sample in samples:
        own = motion.take(sample.rows)
        order = estimate_interleave(sample, own)
        moves = changes_in_time(own, sample.slice_index, sample.pixels.center_mm, order)
        n_segments.append(1 + int((moves > SAME_PLACE_MM).sum()))
        interleave.append(order if n_segments[-1] > 1 else None)
    return n_segments, interleave
