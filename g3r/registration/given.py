"""Registration by given poses: only the motion to the standard orientation is searched, and the quality is measured."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.planes import Slices
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import Orientation, present_orientation, standard_orientation
from g3r.registration.atlas_search import AtlasPlacement, place_in_atlas, template_fits
from g3r.registration.bias_correction import bias_corrected
from g3r.registration.estimate import Registration
from g3r.registration.head_movement import median_moves_mm, segments_of
from g3r.registration.held_out import held_out_score
from g3r.registration.overlap import overlap_of
from g3r.registration.settings import RegistrationSettings
from g3r.registration.similarity import StackSamples
from g3r.registration.slice_rounds import fitted_in_place
from g3r.run.progress import Progress, no_progress

logger = logging.getLogger(__name__)

GIVEN = "given poses"
"""Stands in place of the name of an initialisation."""

JUMP_MM = 3.0
"""Consecutive slices whose poses differ by more are in two motion segments; a lower limit would separate all slices,
since each has a pose of its own."""

SAME_CORRELATION = 0.01
"""Slices are in standard orientation already if their correlation with the template is no more than this below the
best: the orientation is known no better, and so poses of a run in standard space keep their frame."""


@dataclass(frozen=True, kw_only=True)
class GivenPoses:
    """Poses of slices, given instead of searched.

    Args:
        stack_id: [K] number of the stack.
        slice_index: [K] number of the slice in its stack.
        motion: [K] (world from header), from where the stack's affine puts a point to where it is.
        notes: on the source of the poses, for the record.
    """

    stack_id: NDArray[np.int64]
    slice_index: NDArray[np.int64]
    motion: RigidPose
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.motion)

    def __repr__(self) -> str:
        return f"GivenPoses({len(self)} slices of {len(np.unique(self.stack_id))} stacks)"

    def motion_of(self, slices: Slices) -> RigidPose:
        """Motions of some slices, in their order.

        Raises:
            InputError: a slice has no pose.
        """
        keys = zip(self.stack_id.tolist(), self.slice_index.tolist(), strict=True)
        row = {key: n for n, key in enumerate(keys)}
        wanted = list(zip(slices.stack_id.tolist(), slices.slice_index.tolist(), strict=True))
        missing = [key for key in wanted if key not in row]
        if missing:
            stack, index = missing[0]
            raise InputError(
                f"slice {index} of stack {stack} has no given pose (of {len(self)}); pass the stacks that the poses "
                "were read with"
            )
        return self.motion.take([row[key] for key in wanted])


def measure(
    slices: Slices,
    given: GivenPoses,
    settings: RegistrationSettings,
    progress: Progress = no_progress,
    template: AtlasTemplate | None = None,
) -> Registration:
    """A registration by given poses: gains, weights and agreement, with the head in standard orientation.

    Args:
        slices: normalised, at their header poses.
        given: poses of all of them.
        settings: whether the standard orientation is wanted, voxel size of the volume that slices are compared with.
        progress: called with the rounds done and their total.
        template: atlas template; None leaves the head where it is.

    Raises:
        InputError: a slice has no pose.
    """
    motion, even = given.motion_of(slices), bias_corrected(slices)
    samples = StackSamples.of_all(even, settings.n_candidates)
    fitted = fitted_in_place(even.with_motion(motion), settings, progress)
    placed, orientation = None, None
    if template is not None and settings.template and settings.standard_orientation:
        placed, orientation = _orientation(fitted.slices, settings, template)
    pose = fitted.slices.planes.pose if orientation is None else orientation.pose
    motion = pose @ slices.header_pose.inverse()
    held_out, overlap = None, None
    if len(samples) > 1:
        missing = any(sample.profile.has_missing for sample in samples)
        fill = _fill(placed, orientation) if missing else None
        held_out = held_out_score(even, samples, motion, fill).agreements(samples, fitted.weight)
        overlap = overlap_of(even, samples, motion) if missing else None
    n_segments, interleave = segments_of(samples, motion, JUMP_MM)
    return Registration(
        slices=slices.with_pose(pose),
        gain=fitted.gain,
        weight=fitted.weight,
        ncc=fitted.ncc,
        held_out=held_out,
        initialisation=GIVEN,
        initialisations={},
        interleave=interleave,
        n_segments=n_segments,
        median_move_mm=median_moves_mm(samples, motion),
        orientation=orientation,
        history=fitted.history,
        profiles=[sample.profile for sample in samples],
        overlap=overlap,
    )


def with_pixels_of(slices: Slices, registration: Registration) -> Registration:
    """A registration whose slices have the pixels of the slices to be fitted.

    Raises:
        InputError: the two are not about the same slices.
    """
    found = registration.slices
    slices = slices.take(~np.isin(slices.stack_id, [n for n, _ in registration.left_out]))
    if not (np.array_equal(found.stack_id, slices.stack_id) and np.array_equal(found.slice_index, slices.slice_index)):
        raise InputError(
            f"registration of {len(found)} slices; expected {len(slices)} slices of these stacks in their order; "
            "register the same stacks with the same masks"
        )
    return replace(registration, slices=slices.with_pose(found.planes.pose))


def _orientation(
    posed: Slices, settings: RegistrationSettings, template: AtlasTemplate
) -> tuple[AtlasPlacement | None, Orientation | None]:
    """Placement in the atlas, and the slices in standard orientation: at their present poses if these are standard."""
    as_headers = replace(posed, header_pose=posed.planes.pose)
    if not template_fits(as_headers, template):
        return None, None
    samples = StackSamples.of_all(as_headers, settings.n_candidates)
    rng = np.random.default_rng([settings.seed, 0])
    placed = place_in_atlas(as_headers, samples, template, rng)
    here = present_orientation(as_headers, placed.templates)
    found = standard_orientation(as_headers, placed.templates, placed.motion(len(posed), samples), rng)
    logger.info("given poses: correlation %.3f with the template where they are", here.correlation)
    if found is not None and here.correlation >= found.correlation - SAME_CORRELATION:
        return placed, replace(here, rival=found.rival)
    return placed, found


def _fill(placed: AtlasPlacement | None, orientation: Orientation | None) -> PlacedHead | None:
    """The template that stands for what stacks lack, if the slices are in its frame."""
    if placed is None or orientation is None:
        return None
    return next(one for one in placed.templates if one.weeks == orientation.weeks)
