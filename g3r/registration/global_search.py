"""The global search: initialisations are scored by held-out stacks, and the best one is refined by motion segments."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import into_atlas
from g3r.registration.atlas_search import AtlasPlacement, ScaledTemplate, place_in_atlas
from g3r.registration.held_out import HeldOutScore, held_out_score, held_out_scores
from g3r.registration.motion_segments import STEADY_MM, head_distance_mm
from g3r.registration.segment_search import aligned_to, collapse_to_rigid, refine_segments, rigid_or_segments
from g3r.registration.settings import RegistrationSettings
from g3r.registration.similarity import StackSamples
from g3r.registration.stack_registration import register_stacks
from g3r.registration.thresholds import (
    MIN_COST_GAIN,
    MIN_SINGLE_CORRELATION,
    MIN_SINGLE_GAIN,
    MIN_SINGLE_GAIN_PER_SAMPLE,
    RETRY_BELOW_CORRELATION,
    RETRY_WITH_TEMPLATE_BELOW,
)
from g3r.registration.unseen import with_header_spans
from g3r.run.deadline import Deadline

logger = logging.getLogger(__name__)

AGREEING_SHARE = 0.9
"""Share of the slices that two attempts from different starts must put in the same places for a search to end."""


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """Result of the search.

    Args:
        motion: [K] world from header.
        initialisation: name of the initialisation that it started from.
        initialisations: held-out correlation of every initialisation, stack by stack.
        placed: the slices in the atlas template; None without one.
        fill: template for the parts of the head that stacks lack; None where nothing is missing.
        score: held-out score of these motions; None for a single stack.
    """

    motion: RigidPose
    initialisation: str
    initialisations: dict[str, list[float]]
    placed: AtlasPlacement | None
    fill: PlacedHead | None = None
    score: HeldOutScore | None = None


@dataclass(frozen=True)
class _Candidate:
    """Motions [K] of all slices (world from header), their held-out score, and the initialisation they come from."""

    name: str
    motion: RigidPose
    score: HeldOutScore

    @property
    def cost(self) -> float:
        """Lower is better."""
        return self.score.cost


@dataclass(frozen=True)
class _Frame:
    """The slices in the atlas template, and the template where it stands for what is missing; None without either."""

    placed: AtlasPlacement | None = None
    fill: ScaledTemplate | None = None


@dataclass(frozen=True)
class GlobalSearch:
    """The search for the poses of two or more stacks.

    Args:
        slices: of all stacks.
        samples: the thinned pixels of each stack.
        settings: which initialisations, how many attempts.
        template: atlas template; None skips that initialisation.
    """

    slices: Slices
    samples: list[StackSamples]
    settings: RegistrationSettings
    template: AtlasTemplate | None

    def run(self, proposals: Mapping[str, RigidPose], deadline: Deadline | None = None) -> SearchResult:
        """Search until every stack is well predicted by the others, two attempts agree, or the attempts are used up.

        Each attempt begins at the next best initialisation, and the last one at the best motions so far, with all
        others as candidates: segments that one attempt has missed another may have found.

        Args:
            proposals: motions [K] (world from header) by other means, by name.
            deadline: no attempt begins after it, and the first one ends by it if it can.
        """
        rng = np.random.default_rng([self.settings.seed, 0])
        starts, frame = self._starts(proposals, rng)
        ranked = sorted(starts, key=lambda one: one.cost)
        sure = RETRY_BELOW_CORRELATION if frame.fill is None else RETRY_WITH_TEMPLATE_BELOW
        best, found = ranked[0], list[RigidPose]()
        for attempt in range(max(1, self.settings.attempts) if self.settings.segments else 0):
            combines = attempt > 1 and attempt == self.settings.attempts - 1
            start = best if combines else ranked[attempt % len(ranked)]
            others = found if combines else [one.motion for one in starts if one is not start]
            now = self._in_segments(start, others, frame.fill, rng, deadline)
            agrees = bool(found) and self._agree(best.motion, now.motion)
            found.append(now.motion)
            best = min(best, now, key=lambda one: one.cost)
            lowest = min(best.score.correlations)
            if lowest >= sure or agrees or (deadline is not None and deadline.record_whether_passed()):
                break
            rng = np.random.default_rng([self.settings.seed, attempt + 1])
            logger.info("attempt %d: a stack correlates %.2f with the others", attempt + 1, lowest)
        return SearchResult(
            motion=best.motion,
            initialisation=best.name,
            initialisations={one.name: one.score.correlations for one in starts},
            placed=frame.placed,
            fill=frame.fill,
            score=best.score,
        )

    def _agree(self, one: RigidPose, other: RigidPose) -> bool:
        """Whether two sets of motions [K] put nearly all slices in the same places to each other."""
        center_mm = np.mean([sample.pixels.center_mm for sample in self.samples], axis=0)
        apart_mm = head_distance_mm(one, aligned_to(self.slices, one, other), center_mm)
        return bool((np.diagonal(apart_mm) < STEADY_MM).mean() >= AGREEING_SHARE)

    def _starts(self, proposals: Mapping[str, RigidPose], rng: np.random.Generator) -> tuple[list[_Candidate], _Frame]:
        """The initialisations, and the frame that they are in."""
        slices, samples, frame = self.slices, self.samples, _Frame()
        motions = {"headers": RigidPose.identity(len(slices))}
        if self.settings.network:
            motions |= dict(proposals)
        if self.settings.stacks:
            motions["stacks"] = register_stacks(slices).world_from_header()
        if self.template is not None:
            placed = place_in_atlas(slices, samples, self.template, rng)
            in_atlas, frame = placed.motion(len(slices), samples), _Frame(placed)
            if any(sample.profile.has_missing for sample in samples):
                # the template stands for what is missing, so every initialisation has to be in its frame
                frame, fill = _Frame(placed, placed.template), placed.template
                motions = {name: self._in_frame(motion, in_atlas, fill, rng) for name, motion in motions.items()}
            motions["template"] = in_atlas
        scores = held_out_scores(slices, samples, motions, frame.fill)
        return [_Candidate(name, motion, scores[name]) for name, motion in motions.items()], frame

    def _in_frame(
        self, motion: RigidPose, in_atlas: RigidPose, fill: ScaledTemplate, rng: np.random.Generator
    ) -> RigidPose:
        """Motions in the frame of the template: as the stacks were placed in it, or by a search of their own."""
        aligned = aligned_to(self.slices, in_atlas, motion)
        moved = into_atlas(self.slices, motion, fill, rng)
        return min(aligned, moved, key=lambda one: held_out_score(self.slices, self.samples, one, fill).cost)

    def _in_segments(
        self,
        start: _Candidate,
        others: Sequence[RigidPose],
        fill: ScaledTemplate | None,
        rng: np.random.Generator,
        deadline: Deadline | None,
    ) -> _Candidate:
        """Motion segments that predict the stacks better than the motions to start from, or these.

        Args:
            start: motions to start from.
            others: further motions [K], candidates in the first round.
            fill: see `volume_without`.
            rng: source of randomness.
            deadline: see `refine_segments`.
        """
        slices, samples = self.slices, self.samples
        aligned = [aligned_to(slices, start.motion, other) for other in others]
        segmented, placements = refine_segments(
            slices, samples, start.motion, aligned, rng, deadline, fill, start.score
        )
        interleave = [placement.segments.interleave for placement in placements]
        segmented = collapse_to_rigid(slices, samples, segmented, interleave, fill)
        after = _Candidate(start.name, segmented, held_out_score(slices, samples, segmented, fill))
        # with parts missing, segments gain less; a start from the template alone was not fitted to the other
        # stacks, so any gain counts
        needed = 0.0 if fill is not None and start.name == "template" else MIN_COST_GAIN
        return after if after.cost <= start.cost - needed else start


def search_single(
    slices: Slices, sample: StackSamples, settings: RegistrationSettings, template: AtlasTemplate | None
) -> SearchResult:
    """Motions of the slices of a single stack, whose only and rough reference is the atlas template.

    Args:
        slices: of one stack.
        sample: its thinned pixels.
        settings: whether motion segments are searched.
        template: atlas template; None leaves the slices at their headers.
    """
    motion = RigidPose.identity(len(slices))
    if template is None:
        return SearchResult(motion=motion, initialisation="headers", initialisations={}, placed=None)
    placed = place_in_atlas(slices, [sample], template, np.random.default_rng([settings.seed, 0]))
    if not settings.segments:
        return SearchResult(motion=motion, initialisation="headers", initialisations={}, placed=placed)
    (placement,), head = placed.placement, placed.template
    segments = placement.motion
    if sample.profile.has_missing:
        segments = with_header_spans(slices.take(sample.rows).header_pose, segments, sample.slice_index)
    motion, is_rigid = rigid_or_segments(
        slices,
        sample,
        segments,
        placement.segments.interleave,
        head.volume,
        head.grid,
        min_cost_gain=max(MIN_SINGLE_GAIN, MIN_SINGLE_GAIN_PER_SAMPLE * sample.pixels.n_samples),
        min_correlation=MIN_SINGLE_CORRELATION,
    )
    initialisation = "headers" if is_rigid else "template"
    return SearchResult(motion=motion, initialisation=initialisation, initialisations={}, placed=placed)
