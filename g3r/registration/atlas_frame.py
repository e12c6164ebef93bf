"""The frame of the result: the standard orientation of the atlas, or the frame of the scanner."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid_robust
from g3r.registration.atlas_search import ScaledTemplate
from g3r.registration.pose_sampling import angle_deg, rotations_about, uniform_rotations
from g3r.registration.segment_search import aligned_to
from g3r.registration.similarity import SearchPixels, correlation, random_climb
from g3r.registration.so3_search import (
    N_FOLLOWED,
    N_FOLLOWED_OF_STACK,
    N_ORIENTATIONS,
    STACK_DISTANCE_DEG,
    best_orientations,
)
from g3r.registration.thresholds import MIN_ATLAS_CORRELATION, MIN_RIVAL_MARGIN

logger = logging.getLogger(__name__)

HEADER_REACH_MM = 2.0
"""Distance from the common motion at which a slice has half its weight in the estimate of that motion."""

ROUNDS = ((10.0, 4.0), (5.0, 2.0), (2.5, 1.0), (1.2, 0.5), (0.6, 0.3))
"""Random rotations (degrees) and translations (mm) of the whole head, round by round."""
N_CANDIDATES = 1000

RIVAL_DEG = 30.0
"""An orientation at least this far from the chosen one counts as another one."""


@dataclass(frozen=True, kw_only=True)
class Orientation:
    """Poses of all slices in the atlas frame (RAS, the mid-sagittal plane at x = 0), and how well they fit.

    Args:
        pose: [K] world from plane.
        correlation: with the atlas template, outline included.
        weeks: age of the template.
        scale: factor by which it was enlarged to fit.
        rival: correlation in the best of all orientations at least `RIVAL_DEG` away; None if no candidate is that far
            away, and with several stacks, whose headers hold them together, so that no other orientation is tried.
    """

    pose: RigidPose
    correlation: float
    weeks: float
    scale: float
    rival: float | None = None

    @property
    def is_doubtful(self) -> bool:
        """Whether the head fits the template about as well in another orientation."""
        return self.rival is not None and self.correlation - self.rival < MIN_RIVAL_MARGIN


def standard_orientation(
    slices: Slices, templates: Sequence[ScaledTemplate], start: RigidPose, rng: np.random.Generator
) -> Orientation | None:
    """Move all slices together so that the head is oriented as an atlas template.

    A single stack consists of parallel slices, which may fit in several orientations. So all orientations are searched
    once more, with its slices as they now lie to each other.

    Args:
        slices: at their final poses, in any frame.
        templates: atlas templates of the subject's size; the one that fits best after the first round decides.
        start: motions [K] (world from header) into the atlas frame, roughly.
        rng: source of randomness.

    Returns:
        None where no orientation fits well enough to be called standard.
    """
    present = slices.world_from_header()
    common = aligned_to(slices, start, present) @ present.inverse()
    pixels = SearchPixels.of(slices)
    found = [_moved_to(template, pixels, common.take([0]), ROUNDS[:1], rng) for template in templates]
    first = max(found, key=lambda one: one.correlation)
    found = [_moved_to(first.template, pixels, first.motion, ROUNDS[1:], rng)]
    if len(np.unique(slices.stack_id)) == 1:
        found += _in_all_orientations(templates, pixels, rng)
    best = max(found, key=lambda one: one.correlation)
    far = [one for one in found if angle_deg(one.motion.rotation[0], best.motion.rotation[0]) > RIVAL_DEG]
    rival = max((one.correlation for one in far), default=None)
    weeks = best.template.weeks
    logger.info(
        "standard orientation: correlation %.2f with the atlas template of %.0f weeks%s",
        best.correlation,
        weeks,
        "" if rival is None else f", {rival:.2f} in another orientation",
    )
    if best.correlation < MIN_ATLAS_CORRELATION:
        return None
    pose = best.motion @ slices.planes.pose
    return Orientation(pose=pose, correlation=best.correlation, weeks=weeks, scale=best.template.scale, rival=rival)


def present_orientation(slices: Slices, templates: Sequence[ScaledTemplate]) -> Orientation:
    """How well slices fit the atlas templates at their present poses.

    Args:
        slices: at their poses.
        templates: atlas templates of the subject's size; the one that fits best decides.
    """
    pixels, still = SearchPixels.of(slices), RigidPose.identity(1)
    found = [(float(correlation(pixels.moments(one.volume, one.grid, still).sum(1))[0]), one) for one in templates]
    best, template = max(found, key=lambda one: one[0])
    return Orientation(pose=slices.planes.pose, correlation=best, weeks=template.weeks, scale=template.scale)


def into_atlas(slices: Slices, motion: RigidPose, template: ScaledTemplate, rng: np.random.Generator) -> RigidPose:
    """Motions [K] after the one further motion that all slices need to fit a template, in whatever orientation.

    Args:
        slices: K slices.
        motion: [K] world from header, which holds them together.
        template: atlas template of the subject's size.
        rng: source of randomness.
    """
    pixels = SearchPixels.of(slices.with_motion(motion))
    found = _in_all_orientations([template], pixels, rng, n_most=N_FOLLOWED, rounds=ROUNDS[:3])
    return max(found, key=lambda one: one.correlation).motion @ motion


@dataclass(frozen=True)
class _Fit:
    """All slices moved to a template: their correlation with it, and the motion [1]."""

    correlation: float
    motion: RigidPose
    template: ScaledTemplate


def _in_all_orientations(
    templates: Sequence[ScaledTemplate],
    pixels: SearchPixels,
    rng: np.random.Generator,
    n_most: int = N_FOLLOWED_OF_STACK,
    rounds: Sequence[tuple[float, float]] = ROUNDS,
) -> list[_Fit]:
    """Fits of the slices to each template, from the orientations in which they correlate best."""
    rotation = uniform_rotations(N_ORIENTATIONS)
    found = []
    for template in templates:
        motion = rotations_about(rotation, pixels.center_mm, template.center_mm)
        agreement = correlation(pixels.moments(template.volume, template.grid, motion, nearest=True).sum(1))
        for base in best_orientations(rotation, agreement, n_most, STACK_DISTANCE_DEG):
            start = rotations_about(base[None], pixels.center_mm, template.center_mm)
            found.append(_moved_to(template, pixels, start, rounds, rng))
    return found


def _moved_to(
    template: ScaledTemplate,
    pixels: SearchPixels,
    motion: RigidPose,
    rounds: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> _Fit:
    """The best fit of all slices to a template, after some of `ROUNDS`."""
    motion, highest = random_climb(pixels, template.volume, template.grid, motion, rounds, N_CANDIDATES, rng)
    return _Fit(highest, motion, template)


def centred_on_headers(slices: Slices) -> Slices:
    """Remove the motion that all slices share relative to their headers.

    Poses are determined up to one rigid motion of the whole head. This choice keeps the volume where the
    scanner's coordinates put it, on (robust) average over all slices.
    """
    return slices.with_pose(motion_to_headers(slices) @ slices.planes.pose)


def motion_to_headers(slices: Slices) -> RigidPose:
    """The one motion that takes all slices back to their headers, by a robust mean in which few strays hardly count."""
    corners = slices.planes.corners_mm()
    here = slices.planes.pose.apply(corners).reshape(-1, 3)
    header = slices.header_pose.apply(corners).reshape(-1, 3)
    area = np.repeat((slices.planes.shape * slices.planes.spacing_mm).prod(1), corners.shape[1])
    back, _ = fit_rigid_robust(here, header, scale_mm=HEADER_REACH_MM, n_rounds=10, weight=area)
    return back
