"""The global search: initialisations are scored by held-out stacks, and the best one is refined by motion segments."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.atlas_search import AtlasPlacement, place_in_atlas
from g3r.registration.held_out import HeldOutScore, best_initialisation, held_out_score
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
)
from g3r.registration.unseen import with_header_spans
from g3r.run.deadline import Deadline

logger = logging.getLogger(__name__)


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
        """Search until every stack is well predicted by the others, or the attempts are used up.

        Args:
            proposals: motions [K] (world from header) by other means, by name.
            deadline: no attempt begins after it, and the first one ends by it if it can.
        """
        initialisations = {"headers": RigidPose.identity(len(self.slices))}
        if self.settings.network:
            initialisations |= dict(proposals)
        if self.settings.stacks:
            initialisations["stacks"] = register_stacks(self.slices).world_from_header()
        best: SearchResult | None = None
        for attempt in range(max(1, self.settings.attempts)):
            rng = np.random.default_rng([self.settings.seed, attempt])
            found = self._attempt(initialisations, rng, deadline)
            if best is None or _score(found).cost < _score(best).cost:
                best = found
            lowest = min(_score(best).correlations)
            finished = lowest >= RETRY_BELOW_CORRELATION or not self.settings.segments
            if finished or (deadline is not None and deadline.record_whether_passed()):
                break
            logger.info("attempt %d: a stack correlates %.2f with the others", attempt + 1, lowest)
        assert best is not None
        return best

    def _attempt(
        self, initialisations: dict[str, RigidPose], rng: np.random.Generator, deadline: Deadline | None
    ) -> SearchResult:
        slices, samples, placed, fill = self.slices, self.samples, None, None
        if self.template is not None:
            placed = place_in_atlas(slices, samples, self.template, rng)
            in_atlas = placed.motion(len(slices), samples)
            if any(sample.profile.has_missing for sample in samples):
                # the template stands for what is missing, so every initialisation has to be in its frame
                fill = placed.template
                initialisations = {
                    name: aligned_to(slices, in_atlas, motion) for name, motion in initialisations.items()
                }
            initialisations = {**initialisations, "template": in_atlas}
        name, scores = best_initialisation(slices, samples, initialisations, fill)
        motion, score = initialisations[name], scores[name]
        if self.settings.segments:
            others = [aligned_to(slices, motion, other) for key, other in initialisations.items() if key != name]
            segmented, placements = refine_segments(slices, samples, motion, others, rng, deadline, fill, score)
            interleave = [placement.segments.interleave for placement in placements]
            segmented = collapse_to_rigid(slices, samples, segmented, interleave, fill)
            after = held_out_score(slices, samples, segmented, fill)
            # with parts missing, segments gain less; a start from the template alone was not fitted to the other
            # stacks, so any gain counts
            needed = 0.0 if fill is not None and name == "template" else MIN_COST_GAIN
            if after.cost <= score.cost - needed:
                motion, score = segmented, after
        correlations = {key: value.correlations for key, value in scores.items()}
        return SearchResult(
            motion=motion, initialisation=name, initialisations=correlations, placed=placed, fill=fill, score=score
        )


def _score(found: SearchResult) -> HeldOutScore:
    assert found.score is not None
    return found.score


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
