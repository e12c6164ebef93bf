"""Pose of an unknown head: its stacks are matched with atlas templates in all orientations.

The search is exhaustive and cheap: a few thousand orientations of a few thousand pixels. It gives capture
range (a head in any orientation, motion segments 25 degrees apart) and the standard orientation of the result.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from g3r.acquisition.area_profile import head_volume_mm3
from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.held_out import predict
from g3r.registration.placement import Placement, refine_placement
from g3r.registration.pose_sampling import angle_deg, rotations_about, uniform_rotations
from g3r.registration.similarity import StackSamples, correlation
from g3r.registration.so3_search import N_ORIENTATIONS, best_orientations, place_around, stack_orientations

logger = logging.getLogger(__name__)

TEMPLATE_BLUR_VOXELS = 0.8

SCALE_RANGE = (0.75, 1.33)
"""Factors by which a template may be scaled to the subject's size."""

REFINEMENT = ((12.0, 5.0), (8.0, 4.0), (8.0, 4.0), (5.0, 3.0), (5.0, 3.0))
"""Random rotations (degrees) and translations (mm) of the rounds of placing segments in the template."""

SAME_DEG = 30.0
"""Orientations nearer to each other than this are searched as one."""

N_PLACEMENTS = 4
"""Placements of each stack that are refined."""

HEADER_PENALTY, HEADER_DEG = 8.0, 25.0
"""Penalty of two stacks whose angle differs from that of their headers: the first times log(1 + (angle / second)^2)."""


@dataclass(frozen=True, kw_only=True)
class ScaledTemplate(PlacedHead):
    """A head of an atlas template in the atlas frame, of about the subject's age, scaled to its size.

    Args:
        volume: [I, J, K] blurred as thick slices are.
        grid: scaled about the centre of the head.
        center_mm: [3] of the head.
        weeks: its age.
        scale: by which it was enlarged.
    """

    weeks: float
    scale: float


@dataclass(frozen=True)
class AtlasPlacement:
    """Slices in the atlas frame.

    Args:
        placement: of each stack.
        template: the one used.
        templates: those of about the subject's size.
    """

    placement: list[Placement]
    template: ScaledTemplate
    templates: list[ScaledTemplate]

    def motion(self, n_slices: int, samples: list[StackSamples]) -> RigidPose:
        """Motions [K] of all slices (world from header)."""
        motion = RigidPose.identity(n_slices)
        for sample, one in zip(samples, self.placement, strict=True):
            motion = motion.with_rows(sample.rows, one.motion)
        return motion


def place_in_atlas(
    slices: Slices, samples: list[StackSamples], template: AtlasTemplate, rng: np.random.Generator
) -> AtlasPlacement:
    """Motions of all slices into the atlas frame.

    First one orientation is found for the whole head, with its stacks as the headers place them to each other; then the
    motion segments of each stack around it. Several orientations are followed, and the cheapest is taken.

    Args:
        slices: of all stacks.
        samples: the thinned pixels of each stack.
        template: heads of several ages.
        rng: source of randomness.
    """
    templates = nearest_templates(slices, template)
    few = uniform_rotations(N_ORIENTATIONS // 4)
    scaled = max(templates, key=lambda one: float(_head_correlation(samples, one, few).max()))
    bases = template_orientations(samples, scaled)
    # several orientations that fit about as well are a sign that the headers do not hold the stacks together
    by_stack = len(bases) > 1
    candidates = [_stack_placements(sample, scaled, bases, by_stack, rng) for sample in samples]
    placement = _consistent(samples, candidates)
    for rotation_deg, translation_mm in REFINEMENT[2:]:
        placement = [
            _refined(sample, one, scaled, rotation_deg, translation_mm, rng)
            for sample, one in zip(samples, placement, strict=True)
        ]
    return AtlasPlacement(placement, scaled, templates)


def template_fits(slices: Slices, template: AtlasTemplate) -> bool:
    """Whether some template has about the masked volume; none has if the masks are not brain masks."""
    volume_mm3 = head_volume_mm3(slices)
    scale = [scaled_template(template, n, volume_mm3).scale for n in range(len(template))]
    fits = any(SCALE_RANGE[0] <= s <= SCALE_RANGE[1] for s in scale)
    if not fits:
        logger.info("masked volume of %.0f ml: no atlas template of that size", volume_mm3 / 1000)
    return fits


def nearest_templates(slices: Slices, template: AtlasTemplate) -> list[ScaledTemplate]:
    """The three templates nearest to the subject's size, scaled to it."""
    volume_mm3 = head_volume_mm3(slices)
    candidates = [scaled_template(template, n, volume_mm3) for n in range(len(template))]
    return sorted(candidates, key=lambda one: abs(np.log(one.scale)))[:3]


def scaled_template(template: AtlasTemplate, number: int, volume_mm3: float) -> ScaledTemplate:
    """One template scaled about its centre to a volume.

    Args:
        template: heads of several ages.
        number: which of them.
        volume_mm3: of the subject's head.
    """
    head = template.head(number)
    scale = float((volume_mm3 / (np.count_nonzero(head.volume > 0) * head.grid.voxel_volume_mm3)) ** (1 / 3))
    return ScaledTemplate(
        volume=gaussian_filter(head.volume, TEMPLATE_BLUR_VOXELS),
        grid=head.grid.scaled_about(head.center_mm, scale),
        center_mm=head.center_mm,
        weeks=float(template.weeks[number]),
        scale=scale,
    )


def template_orientations(samples: list[StackSamples], scaled: ScaledTemplate) -> list[NDArray[np.float64]]:
    """Orientations [3, 3] of the whole head worth following, best first."""
    rotation = uniform_rotations(N_ORIENTATIONS)
    agreement = _head_correlation(samples, scaled, rotation)
    chosen = best_orientations(rotation, agreement)
    logger.info(
        "atlas template of %.0f weeks, scaled by %.2f: correlation %.2f, %d orientations to follow",
        scaled.weeks,
        scaled.scale,
        agreement.max(),
        len(chosen),
    )
    return chosen


def _head_correlation(
    samples: list[StackSamples], scaled: ScaledTemplate, rotation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Correlation [J] of all stacks with a template, each stack rotated about its own centre."""
    total = np.zeros((len(rotation), 6))
    for sample in samples:
        motion = rotations_about(rotation, sample.pixels.center_mm, scaled.center_mm)
        total += sample.pixels.moments(scaled.volume, scaled.grid, motion, nearest=True).sum(1)
    return correlation(total)


def _stack_placements(
    sample: StackSamples,
    scaled: ScaledTemplate,
    bases: list[NDArray[np.float64]],
    by_stack: bool,
    rng: np.random.Generator,
) -> list[tuple[float, Placement]]:
    """Placements of one stack around several orientations, with their costs, cheapest first."""
    if by_stack:
        own = stack_orientations(sample, scaled.center_mm, scaled.volume, scaled.grid)
        bases = bases + [base for base in own if min(angle_deg(base, other) for other in bases) > SAME_DEG]
    found = []
    for base in bases:
        one = place_around(sample, base, scaled.center_mm, scaled.volume, scaled.grid)
        found.append((_cost(sample, one, scaled), one))
    found.sort(key=lambda candidate: candidate[0])
    refined = []
    for _, one in found[:N_PLACEMENTS]:
        for rotation_deg, translation_mm in REFINEMENT[:2]:
            one = _refined(sample, one, scaled, rotation_deg, translation_mm, rng)
        refined.append((_cost(sample, one, scaled), one))
    return sorted(refined, key=lambda candidate: candidate[0])


def _consistent(samples: list[StackSamples], candidates: list[list[tuple[float, Placement]]]) -> list[Placement]:
    """One candidate for each stack: the least sum of their costs and of penalties for disagreement with headers."""
    mean = [[Rotation.from_matrix(one.motion.rotation).mean().as_matrix() for _, one in c] for c in candidates]
    best: tuple[float, list[int]] | None = None
    for first, stack in [(n, k) for k, c in enumerate(candidates) for n in range(len(c))]:
        choice = [0] * len(samples)
        choice[stack] = first
        for _ in range(3):  # coordinate descent
            for k in range(len(samples)):
                if k != stack:
                    costs = [c[0] + _header_penalty(mean, choice, k, n) for n, c in enumerate(candidates[k])]
                    choice[k] = int(np.argmin(costs))
        total = sum(candidates[k][n][0] for k, n in enumerate(choice))
        total += sum(_header_penalty(mean, choice, k, choice[k]) for k in range(len(samples))) / 2
        if best is None or total < best[0]:
            best = (total, choice)
    assert best is not None
    chosen = [candidates[k][n] for k, n in enumerate(best[1])]
    logger.debug("placed in the atlas template at costs %s", " ".join(f"{cost:.0f}" for cost, _ in chosen))
    return [one for _, one in chosen]


def _header_penalty(mean: list[list[NDArray[np.float64]]], choice: list[int], stack: int, candidate: int) -> float:
    """Penalty of a stack's candidate for its angles to the other stacks' choices, relative to the headers."""
    angles = np.array(
        [float(angle_deg(mean[stack][candidate], mean[k][n])) for k, n in enumerate(choice) if k != stack]
    )
    return float(HEADER_PENALTY * np.log1p((angles / HEADER_DEG) ** 2).sum())


def _cost(sample: StackSamples, one: Placement, scaled: ScaledTemplate) -> float:
    return predict(sample, one.motion, scaled.volume, scaled.grid, one.segments.interleave).cost


def _refined(
    sample: StackSamples,
    one: Placement,
    scaled: ScaledTemplate,
    rotation_deg: float,
    translation_mm: float,
    rng: np.random.Generator,
) -> Placement:
    return refine_placement(
        sample,
        one.motion,
        scaled.volume,
        scaled.grid,
        rotation_deg=rotation_deg,
        translation_mm=translation_mm,
        rng=rng,
    )
