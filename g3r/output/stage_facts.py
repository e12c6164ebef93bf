"""Facts to report of a finished stage: names of lines (`g3r.report.stage_words`), and the values in them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import singledispatch
from typing import Any

import numpy as np

from g3r.fitting.held_out_slices import HeldOutChoice
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.mask_agreement import RefinedMasks
from g3r.fitting.pose_rounds import RefinedPoses
from g3r.fitting.prior_stage import PriorCloud
from g3r.fitting.slice_stage import SliceFit
from g3r.output.mixture import FinishedVolume
from g3r.registration import Registration
from g3r.registration.atlas_frame import centred_on_headers
from g3r.registration.quality import stack_qualities
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW
from g3r.uncertainty.unseen import MENTIONED_ABOVE

Told = tuple[str, dict[str, Any]]
"""Name of a line, and the values to fill in."""

AS_STATED = 0.03
"""A slice profile counts as stated if its relative width differs from 1 by less than this."""

BETTER = 0.005
"""Rise of the correlation between stacks that is worth reporting."""


@singledispatch
def told_of(found: object) -> Iterator[Told]:
    """Lines to report of the result of a stage; none for other types than those below."""
    yield from ()


@told_of.register
def _(found: Registration) -> Iterator[Told]:
    slices = found.slices
    asked = stack_qualities(found, int(slices.stack_id.max()) + 1)
    qualities = [one for one in asked if not one.left_out]
    if found.held_out is None:
        yield "head alone", {}
    else:
        n_agree = sum(one.reliable is not False for one in qualities)
        name = "head found" if n_agree == len(qualities) else "head doubtful" if n_agree else "head lost"
        yield name, {"n_agree": n_agree, "n_stacks": len(qualities)}
    center_mm = slices.header_pose.translation_mm
    motion = centred_on_headers(slices).world_from_header()
    moved = np.einsum("kij,kj->ki", motion.rotation, center_mm) + motion.translation_mm - center_mm
    distance = np.linalg.norm(moved, axis=1)
    facts = {"n_slices": len(slices), "median": f"{np.median(distance):.1f}", "most": f"{distance.max():.0f}"}
    yield "placed", facts


@told_of.register
def _(found: RefinedMasks) -> Iterator[Told]:
    yield "masks refined", {"n_changed": len(found.notes), "n_stacks": len(found.stacks)}


@told_of.register
def _(found: InitialVolumes) -> Iterator[Told]:
    yield "coarse", {"n_slices": len(found.slices)}


@told_of.register
def _(found: PriorVolume) -> Iterator[Told]:
    if found.accepted is not None:
        yield "moved to prior" if found.accepted else "not moved to prior", {}
    else:
        yield "prior used" if found.brain is not None else "prior unused", {}


@told_of.register
def _(found: RefinedPoses) -> Iterator[Told]:
    record = found.record
    if not record.held_out:
        yield "rounds alone", {}
        return
    before, after = record.held_out[0], record.held_out[record.n_kept]
    facts = {"before": f"{before:.2f}", "after": f"{after:.2f}"}
    if not record.n_kept:
        yield "rounds undone", {}
    else:
        yield "rounds helped" if after > before + BETTER else "rounds helped little", facts


@told_of.register
def _(found: PriorCloud) -> Iterator[Told]:
    yield "gaussians", {"n": len(found.cloud)}


@told_of.register
def _(found: HeldOutChoice) -> Iterator[Told]:
    width = found.mean_width
    if width is None:
        yield "width unclear", {}
    elif abs(width - 1) < AS_STATED:
        yield "width as stated", {}
    else:
        yield "width narrower" if width < 1 else "width wider", {"percent": f"{100 * abs(width - 1):.0f}"}


@told_of.register
def _(found: SliceFit) -> Iterator[Told]:
    n_trusted = int((found.weight >= DOWNWEIGHTED_BELOW).sum())
    yield "fitted", {"n_trusted": n_trusted, "n_slices": len(found.weight)}


@told_of.register
def _(found: FinishedVolume) -> Iterator[Told]:
    facts = {"voxel": f"{found.grid.spacing_mm[0]:g}", "volume": f"{found.grid.volume_ml(found.mask):.0f}"}
    if found.unseen.share < MENTIONED_ABOVE:
        yield "volume", facts
    else:
        yield "volume unseen", facts | {"unseen": f"{max(1.0, 100 * found.unseen.share):.0f}"}
