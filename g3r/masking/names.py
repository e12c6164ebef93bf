"""Names of mask files from the names of stacks, in BIDS style if the stack is named so."""

from __future__ import annotations

import os
import re
from pathlib import Path

BIDS_NAME = re.compile(r"sub-[A-Za-z0-9]+(_[a-z]+-[A-Za-z0-9]+)*_[A-Za-z0-9]+")
"""Entities and a suffix, such as sub-01_ses-1_run-2_T2w."""


def mask_name(stack: str | os.PathLike[str]) -> str:
    """The name of a stack's mask, without an ending.

    sub-01_run-1_T2w gives sub-01_run-1_desc-brain_mask, as BIDS derivatives are named; ax gives ax_mask.

    Args:
        stack: file of the stack.
    """
    stem = re.sub(r"\.(nii\.gz|nii|img|hdr|img\.gz)$", "", Path(stack).name)
    if not BIDS_NAME.fullmatch(stem):
        return f"{stem}_mask"
    *entities, _ = stem.split("_")
    kept = [entity for entity in entities if not entity.startswith("desc-")]
    return "_".join([*kept, "desc-brain_mask"])
