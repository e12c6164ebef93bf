"""Registration of all slices: global search of motion segments, then each slice by itself, coarse to fine."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.area_profile import AreaProfile
from g3r.acquisition.atlas_template import AtlasTemplate, PlacedHead
from g3r.acquisition.planes import Slices
from g3r.geometry import RigidPose
from g3r.registration.atlas_frame import Orientation, centred_on_headers, standard_orientation
from g3r.registration.atlas_search import template_fits
from g3r.registration.bias_correction import bias_corrected
from g3r.registration.global_search import GlobalSearch, SearchResult, search_single
from g3r.registration.handedness import handedness
from g3r.registration.head_movement import median_moves_mm, segments_of
from g3r.registration.held_out import held_out_score
from g3r.registration.intruder import misfit_without_each
from g3r.registration.motion_shear import without_excess_shear
from g3r.registration.overlap import Overlap, overlap_of
from g3r.registration.segment_search import aligned_to
from g3r.registration.settings import RegistrationSettings
from g3r.registration.similarity import StackSamples
from g3r.registration.slice_rounds import FittedSlices, correlation_with_all, fitted_in_place, refine_slices
from g3r.registration.stack_quality import StackQuality
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW, MAX_HELD_OUT_LOSS, MIN_NCC_GAIN
from g3r.run.deadline import Deadline
from g3r.run.progress import Progress, no_progress

logger = logging.getLogger(__name__)

SEARCH_SHARE, ROUNDS_SHARE = 0.6, 0.7
"""Share of the available time for the search, and share of the rest for the rounds of slices. The remainder is for
scoring the rigid stacks and for the orientation."""


@dataclass(frozen=True, kw_only=True)
class Registration:
    """Slices in estimated poses (the T_k of G3R Eq. 2), and how well they fit.

    Args:
        slices: in the frame of the result.
        gain: [K] intensity factors.
        weight: [K] slice weights in (0, 1].
        ncc: [K] correlation of each slice with the volume.
        held_out: for each stack the correlation with a volume made of the other stacks, outline included, without
            its down-weighted slices if these are few (`Prediction.agreement`); None for a single stack.
        initialisation: name of the initialisation that the search started from.
        initialisations: held-out correlation of every initialisation, stack by stack.
        interleave: of each stack, as its motion suggests; None for a rigid stack.
        n_segments: motion segments of each stack; 1 for a rigid stack.
        median_move_mm: movement of the head from slice to slice of each stack, see `median_moves_mm`.
        orientation: the standard orientation; None where the result stays in the scanner frame.
        history: figures of each round.
        profiles: of each stack, missing slices included.
        overlap: what stacks saw in common; None for a single stack, and if no stack lacks slices.
        handedness: of each stack, see `registration.handedness`; None if it was not computed.
        misfit_without: of each stack, see `registration.intruder`; None if it was not computed.
        left_out: stacks that do not fit the others, and so have no slices here: their numbers, and their quality when
            they were registered with the others.
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
    median_move_mm: list[float]
    orientation: Orientation | None
    history: list[dict[str, float]] = field(default_factory=list)
    profiles: list[AreaProfile] = field(default_factory=list)
    overlap: Overlap | None = None
    handedness: list[float | None] | None = None
    misfit_without: list[float | None] | None = None
    left_out: list[tuple[int, StackQuality]] = field(default_factory=list)

    def __repr__(self) -> str:
        frame = "scanner frame" if self.orientation is None else "atlas frame"
        ncc = f"median NCC {np.median(self.ncc):.2f}"
        return f"Registration({self.slices!r} from {self.initialisation}, {frame}, {ncc})"


def register(
    slices: Slices,
    settings: RegistrationSettings,
    progress: Progress = no_progress,
    *,
    template: AtlasTemplate | None = None,
    proposals: Mapping[str, RigidPose] | None = None,
    deadline: Deadline | None = None,
) -> Registration:
    """Poses of all slices, from their header poses.

    Args:
        slices: normalised (the 99th percentile near 1), at their header poses.
        settings: which layers run, and how long.
        progress: called with the rounds done and their total.
        template: atlas template; None skips that initialisation.
        proposals: motions [K] (world from header) by other means, such as the pose network, by name.
        deadline: search and rounds are shortened to end by then, if they can.
    """
    given, slices = slices, bias_corrected(slices)
    least_mm = settings.finest_voxel_pixels * slices.typical_pixel_mm
    settings = replace(settings, finest_voxel_mm=max(settings.finest_voxel_mm, least_mm))
    samples = StackSamples.of_all(slices, settings.n_candidates)
    single = len(samples) == 1
    found = _search(slices, samples, settings, template, proposals or {}, deadline)
    n_segments, interleave = segments_of(samples, found.motion)
    rounds = replace(settings, n_rounds=0) if single else settings
    rounds_deadline = deadline.part(ROUNDS_SHARE) if deadline else None
    missing = not single and any(sample.profile.has_missing for sample in samples)
    seen_share = overlap_of(slices, samples, found.motion).seen_share if missing else None
    fitted = refine_slices(slices.with_motion(found.motion), rounds, progress, rounds_deadline, seen_share)
    held_out = None
    if not single:
        rigid = [sample.stack for sample, n in zip(samples, n_segments, strict=True) if n == 1]
        fitted, held_out = _with_rigid_stacks(slices, samples, rigid, found, fitted, settings)
    overlap = overlap_of(slices, samples, fitted.slices.world_from_header()) if missing else None
    orientation, hands = _orientation(fitted, samples, found, settings)
    pose = centred_on_headers(fitted.slices).planes.pose if orientation is None else orientation.pose
    return Registration(
        slices=without_excess_shear(given.with_pose(pose), interleave),
        gain=fitted.gain,
        weight=fitted.weight,
        ncc=fitted.ncc,
        held_out=held_out,
        initialisation=found.initialisation,
        initialisations=found.initialisations,
        interleave=interleave,
        n_segments=n_segments,
        median_move_mm=median_moves_mm(samples, fitted.slices.world_from_header()),
        orientation=orientation,
        history=fitted.history,
        profiles=[sample.profile for sample in samples],
        overlap=overlap,
        handedness=hands,
        misfit_without=misfit_without_each(fitted, settings.finest_voxel_mm, settings.max_pixels),
    )


def _search(
    slices: Slices,
    samples: list[StackSamples],
    settings: RegistrationSettings,
    template: AtlasTemplate | None,
    proposals: Mapping[str, RigidPose],
    deadline: Deadline | None,
) -> SearchResult:
    """The global search, with the atlas template where the settings ask for it and it fits heads of this size."""
    if template is not None and not (settings.template and template_fits(slices, template)):
        template = None
    if len(samples) == 1:
        return search_single(slices, samples[0], settings, template)
    part = deadline.part(SEARCH_SHARE) if deadline else None
    return GlobalSearch(slices, samples, settings, template).run(proposals, part)


def _orientation(
    fitted: FittedSlices, samples: list[StackSamples], found: SearchResult, settings: RegistrationSettings
) -> tuple[Orientation | None, list[float | None] | None]:
    """Standard orientation, and the handedness of each stack; None where settings or search leave them out."""
    asks = settings.check_handedness and len(samples) > 1
    if found.placed is None or not (settings.standard_orientation or asks):
        return None, None
    start = found.placed.motion(len(fitted.slices), samples)
    rng = np.random.default_rng(settings.seed)
    orientation = standard_orientation(fitted.slices, found.placed.templates, start, rng)
    hands = None
    if orientation is not None and asks:
        hands = handedness(fitted.slices.with_pose(orientation.pose), fitted.gain, settings.seed)
    return orientation if settings.standard_orientation else None, hands


def measured_again(registration: Registration, fill: PlacedHead | None = None) -> Registration:
    """The registration with its measures of quality computed anew, for slices with other masks.

    Args:
        registration: whose slices have other masks than they were registered with.
        fill: template for what stacks do not show of the head.
    """
    slices = bias_corrected(registration.slices)
    samples = StackSamples.of_all(slices)
    profiles = [sample.profile for sample in samples]
    motion = slices.world_from_header()
    registration = replace(registration, profiles=profiles, median_move_mm=median_moves_mm(samples, motion))
    if len(samples) == 1:
        return registration
    missing = any(profile.has_missing for profile in profiles)
    score = held_out_score(slices, samples, motion, fill if missing else None)
    overlap = overlap_of(slices, samples, motion) if missing else None
    return replace(registration, held_out=score.agreements(samples, registration.weight), overlap=overlap)


def _with_rigid_stacks(
    slices: Slices,
    samples: list[StackSamples],
    rigid: list[int],
    found: SearchResult,
    fitted: FittedSlices,
    settings: RegistrationSettings,
) -> tuple[FittedSlices, list[float]]:
    """Reset stacks to rigid that gained nothing from poses per slice; also the agreement of each stack with the others.

    Small and thick slices fit noise, and without motion there is nothing to gain. Stacks with several segments
    are not tested: a few slices astray lower their correlation, while all others gain.
    """
    motion, fill, before = found.motion, found.fill, found.score
    assert before is not None
    refined = fitted.slices.world_from_header()
    after = held_out_score(slices, samples, refined, fill)
    if not rigid:
        return fitted, after.agreements(samples, fitted.weight)
    equal = np.ones(len(slices))
    rigid_ncc = correlation_with_all(
        slices.with_motion(motion), equal, equal, settings.finest_voxel_mm, settings.max_pixels
    )
    reverted = [
        sample
        for sample, old, new in zip(samples, before.correlations, after.correlations, strict=True)
        if sample.stack in rigid
        and (
            new < old - MAX_HELD_OUT_LOSS
            or np.median(fitted.ncc[sample.rows]) < np.median(rigid_ncc[sample.rows]) + MIN_NCC_GAIN
        )
    ]
    if not reverted:
        return fitted, after.agreements(samples, fitted.weight)
    # the refined slices as a whole may have drifted from the segments; stacks that are reset must follow
    motion = aligned_to(slices, refined, motion)
    gain, weight = fitted.gain.copy(), fitted.weight.copy()
    for sample in reverted:
        logger.info("stack %d: is rigid, slices keep its motion", sample.stack)
        refined = refined.with_rows(sample.rows, motion.take(sample.rows))
        gain[sample.rows], weight[sample.rows] = 1.0, 1.0  # gains and weights of the refined poses do not apply
    moved = slices.with_motion(refined)
    if settings.n_rounds:
        placed = fitted_in_place(moved, settings)
        for sample in reverted:
            spoilt = sample.rows[_fit_badly(placed, sample.rows)]
            gain[spoilt], weight[spoilt] = placed.gain[spoilt], placed.weight[spoilt]
    ncc = correlation_with_all(moved, gain, weight, settings.finest_voxel_mm, settings.max_pixels)
    kept = replace(fitted, slices=moved, gain=gain, weight=weight, ncc=ncc)
    return kept, held_out_score(slices, samples, refined, fill).agreements(samples, weight)


def _fit_badly(placed: FittedSlices, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which slices of a stack that is in place fit badly, such as one without signal.

    Small slices are not judged: at the ends of a stack what lies beside the brain makes the residual large. Counted as
    misfits, those of `sta30-none` cost 0.2 dB (`fast`).

    Args:
        placed: slices of all stacks in place.
        rows: [N] those of the stack.
    """
    n_pixels = np.bincount(placed.slices.pixel_plane, minlength=len(placed.slices))[rows]
    return (placed.weight[rows] < DOWNWEIGHTED_BELOW) & (n_pixels > np.median(n_pixels) / 2)
