"""Where an unknown head lies: its stacks against mean heads, over the whole sphere of orientations.

The search is exhaustive and cheap: a few thousand orientations of a few thousand pixels. It gives capture
range (a head that lies in any orientation, runs of slices that lie 25 degrees apart) and the standard
orientation of the result.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import head_volume_mm3
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration.normal_equations import correlation
from g3r.registration.placement import Placement, StackSamples, own_moments, predict, refine_placement
from g3r.registration.pose_samples import angle_deg, turns_about, uniform_rotations
from g3r.registration.so3_search import N_ORIENTATIONS, peaks, place_around, stack_orientations

logger = logging.getLogger(__name__)

TEMPLATE_BLUR_VOXELS = 0.8

SCALE_RANGE = (0.75, 1.33)
"""Factors by which a mean head may be scaled to the subject's size."""

REFINEMENT = ((12.0, 5.0), (8.0, 4.0), (8.0, 4.0), (5.0, 3.0), (5.0, 3.0))
"""Random turns (degrees) and shifts (mm) of the rounds of placing runs in the template."""


SAME_DEG = 30.0
"""Orientations nearer to each other than this are searched together."""

N_OPTIONS = 4
"""Placements of each stack that are followed."""

HEADER_PENALTY, HEADER_DEG = 8.0, 25.0
"""Price of two stacks at an angle to what their headers say: the first times log(1 + (angle / second)^2)."""


@dataclass(frozen=True)
class FittedTemplate:
    """A mean head of about the subject's age, scaled to its size.

    Args:
        volume: [I, J, K] blurred as thick slices are.
        grid: scaled about the head's centre.
        center_mm: [3] of the head.
        weeks: its age.
        scale: by which it was enlarged.
    """

    volume: NDArray[np.float32]
    grid: VolumeGrid
    center_mm: NDArray[np.float64]
    weeks: float
    scale: float


@dataclass(frozen=True)
class TemplatePlacement:
    """Slices in the atlas frame.

    Args:
        placement: of each stack.
        head: that was used.
        heads: those of about the subject's size.
        correlation: of all slices with it, at the places found.
    """

    placement: list[Placement]
    head: FittedTemplate
    heads: list[FittedTemplate]
    correlation: float

    def motion(self, n_slices: int, samples: list[StackSamples]) -> RigidPose:
        """Motions [K] of all slices (world from header)."""
        rotation, translation = np.empty((n_slices, 3, 3)), np.empty((n_slices, 3))
        for sample, one in zip(samples, self.placement, strict=True):
            rotation[sample.rows], translation[sample.rows] = one.motion.rotation, one.motion.translation_mm
        return RigidPose(rotation, translation)


def place_in_template(
    slices: Slices, samples: list[StackSamples], template: AtlasTemplate, rng: np.random.Generator
) -> TemplatePlacement:
    """Motions of all slices into the atlas frame.

    First one orientation for the whole head, as the headers hold its stacks together; then the runs of each
    stack around it. Several orientations are followed, and the cheapest stays.

    Args:
        slices: of all stacks.
        samples: the same, as a search sees them.
        template: mean heads.
        rng: source of randomness.
    """
    heads = nearest_templates(slices, template)
    few = uniform_rotations(N_ORIENTATIONS // 4)
    head = max(heads, key=lambda one: float(_whole_correlation(samples, one, few).max()))
    whole = template_orientations(samples, head)
    # several orientations fit about as well: the headers do not hold the stacks together
    by_stack = len(whole) > 1
    options = [_options(sample, head, whole, by_stack, rng) for sample in samples]
    placement = _consistent(samples, options)
    for rotation_deg, translation_mm in REFINEMENT[2:]:
        placement = _refined(samples, placement, head, rotation_deg, translation_mm, rng)
    moments = [
        own_moments(sample.pixels, head.volume, head.grid, one.motion)
        for sample, one in zip(samples, placement, strict=True)
    ]
    return TemplatePlacement(placement, head, heads, float(correlation(np.concatenate(moments).sum(0))))


def template_fits(slices: Slices, template: AtlasTemplate) -> bool:
    """Whether some mean head has about the size of what is masked; without brain masks none has."""
    volume_mm3 = head_volume_mm3(slices)
    scale = [fitted_template(template, n, volume_mm3).scale for n in range(len(template))]
    fits = any(SCALE_RANGE[0] <= s <= SCALE_RANGE[1] for s in scale)
    if not fits:
        logger.info("masked volume of %.0f ml: no mean head of that size", volume_mm3 / 1000)
    return fits


def nearest_templates(slices: Slices, template: AtlasTemplate) -> list[FittedTemplate]:
    """The three mean heads of about the subject's size, scaled to it."""
    volume_mm3 = head_volume_mm3(slices)
    candidates = [fitted_template(template, n, volume_mm3) for n in range(len(template))]
    return sorted(candidates, key=lambda head: abs(np.log(head.scale)))[:3]


def fitted_template(template: AtlasTemplate, number: int, volume_mm3: float) -> FittedTemplate:
    """A mean head scaled about its centre to a volume."""
    volume, grid = template.volume[number], template.grid
    inside = np.argwhere(volume > 0)
    center = grid.world(inside).mean(0)
    scale = float((volume_mm3 / (len(inside) * grid.voxel_volume_mm3)) ** (1 / 3))
    affine = grid.affine.copy()
    affine[:3, :3] *= scale
    affine[:3, 3] = center + scale * (grid.affine[:3, 3] - center)
    blurred = gaussian_filter(volume, TEMPLATE_BLUR_VOXELS)
    return FittedTemplate(blurred, VolumeGrid(grid.shape, affine), center, float(template.weeks[number]), scale)


def template_orientations(samples: list[StackSamples], head: FittedTemplate) -> list[NDArray[np.float64]]:
    """Orientations [3, 3] of the whole head worth following, best first."""
    rotation = uniform_rotations(N_ORIENTATIONS)
    agreement = _whole_correlation(samples, head, rotation)
    chosen = peaks(rotation, agreement)
    logger.info(
        "mean head of %.0f weeks, scaled by %.2f: correlation %.2f, %d orientations to follow",
        head.weeks,
        head.scale,
        agreement.max(),
        len(chosen),
    )
    return chosen


def _whole_correlation(
    samples: list[StackSamples], head: FittedTemplate, rotation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Correlation [J] of all stacks with a head, each stack turned about its own centre."""
    total = np.zeros((len(rotation), 6))
    for sample in samples:
        motion = turns_about(rotation, sample.pixels.center_mm, head.center_mm)
        total += sample.pixels.moments(head.volume, head.grid, motion).sum(1)
    return correlation(total)


def _options(
    sample: StackSamples,
    head: FittedTemplate,
    whole: list[NDArray[np.float64]],
    by_stack: bool,
    rng: np.random.Generator,
) -> list[tuple[float, Placement]]:
    """Placements of one stack around several orientations, with their costs, cheapest first."""
    bases = list(whole)
    if by_stack:
        own = stack_orientations(sample, head.center_mm, head.volume, head.grid)
        bases += [base for base in own if min(angle_deg(base, other) for other in whole) > SAME_DEG]
    found = []
    for base in bases:
        one = place_around(sample, base, head.center_mm, head.volume, head.grid)
        found.append((_cost(sample, one, head), one))
    found.sort(key=lambda option: option[0])
    refined = []
    for _, one in found[:N_OPTIONS]:
        for rotation_deg, translation_mm in REFINEMENT[:2]:
            one = _refined([sample], [one], head, rotation_deg, translation_mm, rng)[0]
        refined.append((_cost(sample, one, head), one))
    return sorted(refined, key=lambda option: option[0])


def _consistent(samples: list[StackSamples], options: list[list[tuple[float, Placement]]]) -> list[Placement]:
    """One option for each stack: the least sum of their costs and of a price for headers that disagree."""
    mean = [[Rotation.from_matrix(one.motion.rotation).mean().as_matrix() for _, one in o] for o in options]
    best: tuple[float, list[int]] | None = None
    for first, stack in [(n, k) for k, o in enumerate(options) for n in range(len(o))]:
        choice = [0] * len(samples)
        choice[stack] = first
        for _ in range(3):  # coordinate descent
            for k in range(len(samples)):
                if k != stack:
                    choice[k] = int(
                        np.argmin([o[0] + _disagreement(mean, choice, k, n) for n, o in enumerate(options[k])])
                    )
        total = sum(options[k][n][0] for k, n in enumerate(choice))
        total += sum(_disagreement(mean, choice, k, choice[k]) for k in range(len(samples))) / 2
        if best is None or total < best[0]:
            best = (total, choice)
    assert best is not None
    chosen = [options[k][n] for k, n in enumerate(best[1])]
    logger.debug("placed in the mean head at costs %s", " ".join(f"{cost:.0f}" for cost, _ in chosen))
    return [one for _, one in chosen]


def _disagreement(mean: list[list[NDArray[np.float64]]], choice: list[int], stack: int, option: int) -> float:
    """Price of one stack's option lying at an angle to those of the other stacks, by the headers."""
    angles = np.array([float(angle_deg(mean[stack][option], mean[k][n])) for k, n in enumerate(choice) if k != stack])
    return float(HEADER_PENALTY * np.log1p((angles / HEADER_DEG) ** 2).sum())


def _cost(sample: StackSamples, one: Placement, head: FittedTemplate) -> float:
    return predict(sample, one.motion, head.volume, head.grid, one.segments.interleave).cost


def _refined(
    samples: list[StackSamples],
    placement: list[Placement],
    head: FittedTemplate,
    rotation_deg: float,
    translation_mm: float,
    rng: np.random.Generator,
) -> list[Placement]:
    return [
        refine_placement(
            sample,
            one.motion,
            head.volume,
            head.grid,
            rotation_deg=rotation_deg,
            translation_mm=translation_mm,
            rng=rng,
        )
        for sample, one in zip(samples, placement, strict=True)
    ]
