"""Small BIDS data sets, a stand-in for g3r-infer, and a result for it to write."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import nibabel as nib
import numpy as np

MASK_ENDS = {"desc": "_desc-brain_mask.nii.gz", "mialsrtk": "_T2w_desc-brain_mask.nii.gz", "plain": "_mask.nii.gz"}
"""Endings of mask file names after the entities of their stack: the three common patterns."""

BROKEN = b"broken"
"""Content of a stack that the stand-in refuses."""

ENDLESS, HUNGRY = b"endless", b"hungry"
"""Content of stacks on which the stand-in hangs, and for which it takes 600 MB of memory."""


def begin(participant: str, session: str | None) -> str:
    """Common prefix of the file names of a session."""
    return f"sub-{participant}" + (f"_ses-{session}" if session else "")


def add_session(
    root: Path,
    participant: str,
    session: str | None,
    stacks: Sequence[tuple[str, bytes | Path, bytes | Path | None]],
    pattern: str = "desc",
    derivative: str = "masks",
) -> Path:
    """Write stacks and masks of a session; returns its anat folder.

    Args:
        root: the data set.
        participant: label.
        session: label, or None.
        stacks: entities between session and suffix (run-1), the image and its mask; each a file or bytes.
        pattern: of mask names, see `MASK_ENDS`.
        derivative: name of the derivative that holds the masks.
    """
    stem = begin(participant, session)
    inside = Path(*stem.split("_")) / "anat"
    masks = root / "derivatives" / derivative / inside
    for folder in (root / inside, masks):
        folder.mkdir(parents=True, exist_ok=True)
    (root / "dataset_description.json").write_text(json.dumps({"Name": "small", "BIDSVersion": "1.10.0"}))
    for entities, image, mask in stacks:
        name = "_".join([stem, entities] if entities else [stem])
        _put(image, root / inside / f"{name}_T2w.nii.gz")
        if mask is not None:
            _put(mask, masks / f"{name}{MASK_ENDS[pattern]}")
    return root / inside


def _put(content: bytes | Path, path: Path) -> None:
    if isinstance(content, Path):
        shutil.copy(content, path)
    else:
        path.write_bytes(content)


def ready_result(folder: Path) -> Path:
    """A small output folder as written by g3r-infer."""
    folder.mkdir(parents=True)
    for name in ("volume", "mask", "uncertainty", "prior_share", "density", "unseen"):
        nib.save(nib.Nifti1Image(np.ones((3, 4, 5), np.float32), np.eye(4)), folder / f"{name}.nii.gz")
    (folder / "slices.tsv").write_text("stack\tslice\n0\t0\n")
    (folder / "sections.png").write_bytes(b"picture")
    (folder / "report.html").write_text("page")
    record = {
        "partial": False,
        "registration": {"reliable": True, "space": "standard", "standard_from_scanner": np.eye(4).tolist()},
        "stacks": [{"name": "-", "n_slices": 9, "n_downweighted_slices": 2, "mask_from": "file"}],
        "seconds": {"registration": 1.5, "volume": 2.0},
        "unseen": {"share": 0.0125, "usable": True},
        "verdict": "use",
        "reasons": ["3 of 3 stacks agree with each other"],
    }
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def stand_in(result: Path, events: Path, seconds: float = 0.0) -> tuple[str, ...]:
    """A command that stands in for g3r-infer.

    Args:
        result: folder that it copies.
        events: folder in which it writes a file at each start and end.
        seconds: duration of a run.
    """
    events.mkdir(exist_ok=True)
    return (sys.executable, str(Path(__file__).with_name("stand_in.py")), str(result), str(events), str(seconds))
