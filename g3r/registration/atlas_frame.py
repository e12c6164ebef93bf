"""The frame of the result: the standard orientation of the atlas, or the frame of the scanner."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid_robust
from g3r.registration.atlas_search import FittedTemplate
from g3r.registration.pose_sampling import perturbed
from g3r.registration.segment_search import aligned_to
from g3r.registration.similarity import SearchPixels, correlation
from g3r.registration.thresholds import MIN_ATLAS_CORRELATION

logger = logging.getLogger(__name__)

HEADER_REACH_MM = 2.0
"""Distance from the common motion at which a slice counts half in finding it."""

ROUNDS = ((10.0, 4.0), (5.0, 2.0), (2.5, 1.0), (1.2, 0.5), (0.6, 0.3))
"""Random rotations (degrees) and translations (mm) of the whole head, round by round."""
N_CANDIDATES = 1000


@dataclass(frozen=True)
class Orientation:
    """Poses of all slices in the atlas frame (RAS, the mid-sagittal plane at x = 0), and how well they fit.

    Args:
        pose: [K] world from plane.
        correlation: with the atlas template, outline included.
        weeks: age of the template.
        scale: by which it was enlarged to fit.
    """

    pose: RigidPose
    correlation: float
    weeks: float
    scale: float


def standard_orientation(
    slices: Slices, templates: Sequence[FittedTemplate], start: RigidPose, rng: np.random.Generator
) -> Orientation | None:
    """Move all slices together so that the head is oriented as an atlas template.

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
    found = [(*_moved_to(template, pixels, common.take([0]), ROUNDS[:1], rng), template) for template in templates]
    _, motion, template = max(found, key=lambda one: one[0])
    best, motion = _moved_to(template, pixels, motion, ROUNDS[1:], rng)
    logger.info("standard orientation: correlation %.2f with the atlas template of %.0f weeks", best, template.weeks)
    if best < MIN_ATLAS_CORRELATION:
        return None
    return Orientation(motion @ slices.planes.pose, best, template.weeks, template.scale)


def present_orientation(slices: Slices, templates: Sequence[FittedTemplate]) -> Orientation:
    """How well slices fit the atlas templates where they are.

    Args:
        slices: at their poses.
        templates: atlas templates of the subject's size; the one that fits best decides.
    """
    pixels, still = SearchPixels.of(slices), RigidPose.identity(1)
    found = [(float(correlation(pixels.moments(one.volume, one.grid, still).sum(1))[0]), one) for one in templates]
    best, template = max(found, key=lambda one: one[0])
    return Orientation(slices.planes.pose, best, template.weeks, template.scale)


def _moved_to(
    template: FittedTemplate,
    pixels: SearchPixels,
    motion: RigidPose,
    rounds: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> tuple[float, RigidPose]:
    """Best correlation of all slices with a template, and the motion that gives it, after some of `ROUNDS`."""
    agreement = np.zeros(1)
    for rotation_deg, translation_mm in rounds:
        candidate = perturbed(motion, pixels.center_mm, N_CANDIDATES, rotation_deg, translation_mm, rng)
        agreement = correlation(pixels.moments(template.volume, template.grid, candidate).sum(1))
        motion = candidate.take([int(agreement.argmax())])
    return float(agreement.max()), motion


def centred_on_headers(slices: Slices) -> Slices:
    """Remove the motion that all slices share relative to their headers.

    Poses are determined up to one rigid motion of the whole head. This choice keeps the volume where the
    scanner's coordinates put it, on (robust) average over all slices.
    """
    return slices.with_pose(motion_to_headers(slices) @ slices.planes.pose)


def motion_to_headers(slices: Slices) -> RigidPose:
    """The one motion that takes all slices back to their headers, on robust average: few strays hardly count."""
    corners = slices.planes.corners_mm()
    here = slices.planes.pose.apply(corners).reshape(-1, 3)
    header = slices.header_pose.apply(corners).reshape(-1, 3)
    area = np.repeat((slices.planes.shape * slices.planes.spacing_mm).prod(1), corners.shape[1])
    back, _ = fit_rigid_robust(here, header, scale_mm=HEADER_REACH_MM, n_rounds=10, weight=area)
    return back
