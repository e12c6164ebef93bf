"""Records of runs as in run.json, with chosen faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from g3r.acquisition.brain_mask import MaskSource
from g3r.acquisition.slice_profile import ThicknessSource
from g3r.output.record import RegistrationRecord, RunRecord
from g3r.output.stack_record import StackRecord
from g3r.planning.presets import PRESETS
from g3r.registration.quality import registration_reliable, registration_summary
from g3r.registration.stack_quality import StackQuality
from g3r.uncertainty.unseen import UnseenPart


def quality(
    reliable: bool | None = True, held_out: float | None = 0.84, ncc: float | None = 0.95, **others: Any
) -> StackQuality:
    """The quality of a stack; `others` are further fields."""
    fields = {"downweighted_share": 0.1} | others
    return StackQuality(reliable=reliable, held_out_correlation=held_out, median_slice_ncc=ncc, **fields)


def stack(
    name: str,
    found: StackQuality | None = None,
    *,
    thickness_from: ThicknessSource = "sidecar",
    mask_from: MaskSource = "file",
    left_out_share: float = 0.0,
    remarks: Sequence[str] = (),
) -> StackRecord:
    return StackRecord(
        name=name,
        thickness_mm=3.0,
        thickness_from=thickness_from,
        spacing_mm=[0.8, 0.8, 3.3],
        mask_from=mask_from,
        mask_ml=280.0,
        left_out_share=left_out_share,
        remarks=list(remarks),
        n_slices=30,
        n_downweighted_slices=2,
        quality=found or quality(),
        n_segments=1,
    )


def unseen(share: float = 0.0, *, usable: bool = True, extent_known: bool = True) -> UnseenPart:
    return UnseenPart(
        share=share,
        volume_ml=280 * share,
        shown="smooth continuation",
        extent_known=extent_known,
        usable=usable,
        share_by_areas=None if extent_known else 0.4,
    )


def record(*stacks: StackRecord, **facts: Any) -> RunRecord:
    """The record of a run of the given stacks, by default three good ones; `facts` are further fields."""
    found = list(stacks) or [stack(f"stack-{n}.nii.gz") for n in range(3)]
    qualities = [one.quality for one in found if one.quality]
    registration = RegistrationRecord(
        reliable=registration_reliable(qualities),
        summary=registration_summary(qualities),
        initialisation="template",
        held_out_correlation={},
        space="scanner",
        correlation_with_template=None,
        standard_from_scanner=None,
        rounds=[],
    )
    facts = {"unseen": unseen(), **facts}
    return RunRecord(settings=PRESETS["fast"], stacks=found, registration=registration, **facts)
