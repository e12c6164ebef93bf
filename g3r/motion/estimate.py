"""Motion of every slice: rival hypotheses, runs between jerks, then each slice for itself, coarse to fine."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.planes import Slices
from g3r.acquisition.template import AtlasTemplate
from g3r.geometry import RigidPose
from g3r.motion.flattening import flattened
from g3r.motion.hypotheses import (
    MARGIN,
    choose,
    in_frame_of,
    judge,
    moved,
    one_motion_or_runs,
    settle,
    simplify,
)
from g3r.motion.orientation import Orientation, centred_on_headers, standard_orientation
from g3r.motion.placement import StackPixels
from g3r.motion.slice_rounds import SliceRounds, refine_slices
from g3r.motion.stack_registration import register_stacks
from g3r.motion.template_registration import TemplatePlacement, place_in_template, template_fits

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MotionSettings:
    """Which layers run, and how long they search.

    Args:
        flatten: divide slow trends of intensity out of each stack before it is registered.
        template: place runs of slices in mean heads (needs a template); gives the standard orientation.
        network: consider the pose network's proposal.
        stacks: consider stacks registered to each other from many starts.
        runs: place runs of slices again in the volume of the other stacks.
        n_rounds: alternations of volume and slices; 0 leaves the slices where the runs are.
        steps_per_round: Gauss-Newton steps of the slices in a round.
        finest_voxel_mm: voxel of the last rounds.
        pixels_at_most: masked pixels in use; larger subjects are thinned on coarse levels.
        standard_orientation: turn the result into the atlas frame; otherwise it stays in scanner space.
        seed: of the random search.
    """

    flatten: bool = True
    template: bool = True
    network: bool = True
    stacks: bool = True
    runs: bool = True
    n_rounds: int = 12
    steps_per_round: int = 5
    finest_voxel_mm: float = 1.2
    pixels_at_most: int = 400_000
    standard_orientation: bool = True
    seed: int = 0


@dataclass(frozen=True)
class MotionEstimate:
    """Slices in estimated poses with gain [K], trust [K] in (0, 1] and correlation [K] with the volume.

    Args:
        slices: in the frame of the result.
        gain, weight, ncc: see above.
        held_out: for each stack the correlation with a volume made of the other stacks, outline included;
            None for a single stack.
        hypothesis: where the search started.
        hypotheses: held-out correlation of every hypothesis, stack by stack.
        interleave: of each stack, as its motion suggests.
        n_runs: of each stack, between jerks; 1 where it lay still.
        orientation: how the result was turned; None where it stays in scanner space.
        history: one line of figures a round.
    """

    slices: Slices
    gain: NDArray[np.float64]
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    held_out: list[float] | None
    hypothesis: str
    hypotheses: dict[str, list[float]]
    interleave: list[int]
    n_runs: list[int]
    orientation: Orientation | None
    history: list[dict[str, float]] = field(default_factory=list)


def estimate_motion(
    slices: Slices,
    settings: MotionSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    template: AtlasTemplate | None = None,
    proposals: Mapping[str, RigidPose] | None = None,
) -> MotionEstimate:
    """Poses of all slices, from their header poses.

    Args:
        slices: intensities of order one (the 99th percentile near 1), at their header poses.
        settings: which layers, and how long.
        progress: called with (rounds done, rounds in all).
        template: mean heads; None leaves that layer out.
        proposals: motions [K] (world from header) by other means, such as the pose network, by name.
    """
    rng = np.random.default_rng(settings.seed)
    given = slices
    if settings.flatten:
        slices = flattened(slices)
    parts = StackPixels.of_all(slices)
    single = len(parts) == 1
    still = RigidPose.identity(len(slices))
    placed: TemplatePlacement | None = None
    if template is not None and settings.template and template_fits(slices, template):
        placed = place_in_template(slices, parts, template, rng)

    motion, name, judged, interleave, n_runs = still, "headers", {}, [1] * len(parts), [1] * len(parts)
    if not single:
        hypotheses = {"headers": still}
        if placed is not None:
            hypotheses["template"] = placed.motion(len(slices), parts)
        if settings.network:
            hypotheses |= dict(proposals or {})
        if settings.stacks:
            hypotheses["stacks"] = register_stacks(slices)[0].world_from_header()
        name, judgements = choose(slices, parts, hypotheses)
        judged = {key: [p.correlation for p in value.prediction] for key, value in judgements.items()}
        motion = hypotheses[name]
        if settings.runs:
            rivals = [in_frame_of(slices, motion, other) for key, other in hypotheses.items() if key != name]
            motion, placements = settle(slices, parts, motion, rivals, rng)
            interleave = [one.runs.interleave for one in placements]
            motion, shares_one = simplify(slices, parts, motion, interleave)
            n_runs = [
                1 if one_motion else one.runs.n_runs
                for one, one_motion in zip(placements, shares_one, strict=True)
            ]
            if judge(slices, parts, motion).cost > judgements[name].cost - MARGIN:
                motion, n_runs = hypotheses[name], [1] * len(parts)
    elif placed is not None and settings.runs:
        # no other stack holds a single one together; a mean head does, roughly
        only, head = placed.placement[0], placed.head
        interleave = [only.runs.interleave]
        motion, is_one = one_motion_or_runs(
            slices, parts[0], only.motion, interleave[0], head.volume, head.grid
        )
        n_runs = [1 if is_one else only.runs.n_runs]
        name = "headers" if is_one else "template"
    posed = moved(slices, motion)
    rounds = SliceRounds(
        0 if single else settings.n_rounds, settings.steps_per_round, settings.finest_voxel_mm,
        settings.pixels_at_most,
    )  # fmt: skip
    fitted = refine_slices(posed, rounds, progress)
    held_out = None
    if not single:
        final = judge(slices, parts, fitted.slices.world_from_header())
        held_out = [p.correlation for p in final.prediction]
    orientation = None
    if placed is not None and settings.standard_orientation:
        start = placed.motion(len(slices), parts)
        orientation = standard_orientation(fitted.slices, placed.heads, start, rng)
    posed = centred_on_headers(fitted.slices) if orientation is None else orientation.slices
    result = given.with_pose(posed.planes.pose)
    return MotionEstimate(
        result, fitted.gain, fitted.weight, fitted.ncc, held_out, name, judged, interleave, n_runs,
        orientation, fitted.history,
    )  # fmt: skip
