"""The frame of the result: the atlas' standard orientation, or where the scanner says the head is."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.geometry.rigid import fit_rigid_robust
from g3r.registration.candidates import aligned_to
from g3r.registration.normal_equations import correlation
from g3r.registration.pose_samples import SearchPixels, perturbed
from g3r.registration.template_search import FittedTemplate

logger = logging.getLogger(__name__)

HEADER_REACH_MM = 2.0
"""Slices further than this from the common motion hardly take part in finding it."""

RELIABLE_CORRELATION = 0.6
"""Correlation with the mean head, outline included, below which the standard orientation is not known:
0.7 to 0.8 for simulated heads of 24 to 34 weeks, 0.4 for heads lying the wrong way."""

ROUNDS = ((10.0, 4.0), (5.0, 2.0), (2.5, 1.0), (1.2, 0.5), (0.6, 0.3))
N_CANDIDATES = 1000


@dataclass(frozen=True)
class Orientation:
    """Poses of all slices in the atlas frame (RAS, the mid-sagittal plane at x = 0), and how well they fit.

    Args:
        pose: [K] of the slices' own frames.
        correlation: with the mean head, outline included.
        weeks: age of the mean head.
        scale: by which it was enlarged to fit.
    """

    pose: RigidPose
    correlation: float
    weeks: float
    scale: float


def standard_orientation(
    slices: Slices, heads: Sequence[FittedTemplate], start: RigidPose, rng: np.random.Generator
) -> Orientation | None:
    """Turn all slices together so that the head stands as a mean head does.

    Args:
        slices: at their final poses, in any frame.
        heads: mean heads of the subject's size; the one that fits best decides.
        start: motions [K] (world from header) into the atlas frame, roughly.
        rng: source of randomness.

    Returns:
        None where no orientation fits well enough to be called standard.
    """
    present = slices.world_from_header()
    common = aligned_to(slices, start, present) @ present.inverse()
    pixels = SearchPixels.of(slices)
    found = [(*_turned_to(head, pixels, common.take([0]), rng), head) for head in heads]
    best, motion, head = max(found, key=lambda one: one[0])
    logger.info("standard orientation: correlation %.2f with the mean head of %.0f weeks", best, head.weeks)
    if best < RELIABLE_CORRELATION:
        return None
    return Orientation(motion @ slices.planes.pose, best, head.weeks, head.scale)


def _turned_to(
    head: FittedTemplate, pixels: SearchPixels, motion: RigidPose, rng: np.random.Generator
) -> tuple[float, RigidPose]:
    """Best correlation of all slices with a head, and the motion that gives it."""
    agreement = np.zeros(1)
    for rotation_deg, translation_mm in ROUNDS:
        candidate = perturbed(motion, pixels.center_mm, N_CANDIDATES, rotation_deg, translation_mm, rng)
        agreement = correlation(pixels.moments(head.volume, head.grid, candidate).sum(1))
        motion = candidate.take([int(agreement.argmax())])
    return float(agreement.max()), motion


def centred_on_headers(slices: Slices) -> Slices:
    """Take out the motion that all slices share, as their headers see it.

    Poses are determined up to one rigid motion of the whole head. This choice keeps the volume where the
    scanner's coordinates say it is, on (robust) average over all slices.
    """
    corners = slices.planes.corners_mm()
    here = slices.planes.pose.apply(corners).reshape(-1, 3)
    header = slices.header_pose.apply(corners).reshape(-1, 3)
    area = np.repeat((slices.planes.shape * slices.planes.spacing_mm).prod(1), corners.shape[1])
    back, _ = fit_rigid_robust(here, header, scale_mm=HEADER_REACH_MM, n_rounds=10, weight=area)
    return slices.with_pose(back @ slices.planes.pose)
