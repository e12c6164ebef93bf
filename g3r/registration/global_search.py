"""The search for where stacks and their runs of slices lie: every hypothesis tried, the best one followed."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.candidates import (
    MARGIN,
    HeldOutScore,
    aligned_to,
    best_initialisation,
    collapse_to_rigid,
    held_out_score,
    one_motion_or_segments,
    refine_segments,
)
from g3r.registration.placement import StackSamples
from g3r.registration.settings import RegistrationSettings
from g3r.registration.stack_registration import register_stacks
from g3r.registration.template_search import TemplatePlacement, place_in_template
from g3r.run.deadline import Deadline

logger = logging.getLogger(__name__)

SINGLE_MARGIN = 450.0
"""How much cheaper runs must be for a single stack, which only a mean head holds together: to 277 with mild
motion, where one motion for all slices is nearer to the truth (0.7-0.9 mm instead of 0.8-2.6), 691 to 1950
with jerks (15 stacks of development and validation subjects)."""

SETTLED = 0.68
"""Held-out correlation that every stack must reach; below it the search is begun again by other random
numbers. Stacks in place reach 0.66 to 0.9, so that a few of them are searched for again in vain."""


@dataclass(frozen=True)
class Searched:
    """What a search found.

    Args:
        motion: [K] world from header.
        initialisation: where it started.
        initialisations: held-out correlation of every hypothesis, stack by stack.
        placed: the slices in the mean head; None without a template.
    """

    motion: RigidPose
    initialisation: str
    initialisations: dict[str, list[float]]
    placed: TemplatePlacement | None


def search(
    slices: Slices,
    samples: list[StackSamples],
    settings: RegistrationSettings,
    template: AtlasTemplate | None,
    proposals: Mapping[str, RigidPose],
    deadline: Deadline | None = None,
) -> Searched:
    """Motions of the slices of two or more stacks.

    Args:
        slices: of all stacks.
        samples: the same, as a search sees them.
        settings: which hypotheses, how many attempts.
        template: mean heads; None leaves them out.
        proposals: motions [K] (world from header) by other means, by name.
        deadline: no attempt begins after it, and the first one ends by it if it can.
    """
    fixed = {"headers": RigidPose.identity(len(slices))}
    if settings.network:
        fixed |= dict(proposals)
    if settings.stacks:
        fixed["stacks"] = register_stacks(slices)[0].world_from_header()
    best: tuple[HeldOutScore, Searched] | None = None
    for attempt in range(max(1, settings.attempts)):
        rng = np.random.default_rng([settings.seed, attempt])
        judgement, found = _attempt(slices, samples, settings, template, fixed, rng, deadline)
        if best is None or judgement.cost < best[0].cost:
            best = judgement, found
        least = min(p.correlation for p in best[0].prediction)
        if least >= SETTLED or not settings.segments or (deadline is not None and deadline.has_passed()):
            break
        logger.info("attempt %d: a stack correlates %.2f with the others", attempt + 1, least)
    assert best is not None
    return best[1]


def _attempt(
    slices: Slices,
    samples: list[StackSamples],
    settings: RegistrationSettings,
    template: AtlasTemplate | None,
    fixed: Mapping[str, RigidPose],
    rng: np.random.Generator,
    deadline: Deadline | None,
) -> tuple[HeldOutScore, Searched]:
    initialisations, placed = dict(fixed), None
    if template is not None:
        placed = place_in_template(slices, samples, template, rng)
        initialisations["template"] = placed.motion(len(slices), samples)
    name, judgements = best_initialisation(slices, samples, initialisations)
    judged = {key: [p.correlation for p in value.prediction] for key, value in judgements.items()}
    start = initialisations[name]
    motion, judgement = start, judgements[name]
    if settings.segments:
        rivals = [aligned_to(slices, start, other) for key, other in initialisations.items() if key != name]
        settled, placements = refine_segments(slices, samples, start, rivals, rng, deadline)
        settled, _ = collapse_to_rigid(slices, samples, settled, [one.segments.interleave for one in placements])
        after = held_out_score(slices, samples, settled)
        if after.cost <= judgement.cost - MARGIN:
            motion, judgement = settled, after
    return judgement, Searched(motion, name, judged, placed)


def search_single(
    slices: Slices, sample: StackSamples, settings: RegistrationSettings, template: AtlasTemplate | None
) -> Searched:
    """Motions of the slices of one stack: no other stack holds it together, a mean head does, roughly."""
    motion = RigidPose.identity(len(slices))
    if template is None:
        return Searched(motion, "headers", {}, None)
    placed = place_in_template(slices, [sample], template, np.random.default_rng([settings.seed, 0]))
    if not settings.segments:
        return Searched(motion, "headers", {}, placed)
    only, head = placed.placement[0], placed.head
    motion, is_one = one_motion_or_segments(
        slices, sample, only.motion, only.segments.interleave, head.volume, head.grid, SINGLE_MARGIN
    )
    return Searched(motion, "headers" if is_one else "template", {}, placed)
