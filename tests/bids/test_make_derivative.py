"""Derivative from an output folder, without a reconstruction: found masks, replaced and interrupted results."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.bids.dataset import Session, find_sessions
from g3r.bids.derivative import make_derivative, record_path
from g3r.bids.description import relative_url
from tests.bids.data_sets import add_session, ready_result

STACKS = [("run-1", b"x", b"m"), ("run-2", b"x", None)]


@pytest.fixture
def session(tmp_path: Path) -> Session:
    add_session(tmp_path / "raw", "01", None, STACKS)
    return find_sessions(tmp_path / "raw")[0]


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Output folder of two stacks, the second with a found mask."""
    folder = ready_result(tmp_path / "result")
    nib.save(nib.Nifti1Image(np.ones((2, 2, 2), np.uint8), np.eye(4)), folder / "brain-mask-1.nii.gz")
    (folder / "masks.png").write_bytes(b"picture")
    record = json.loads((folder / "run.json").read_text())
    record["stacks"] = [
        {"name": f"sub-01_run-{n}_T2w.nii.gz", "mask_from": source, "standard_from_scanner": np.eye(4).tolist()}
        for n, source in ((1, "file"), (2, "automatic"))
    ]
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def make(session: Session, result: Path, tmp_path: Path) -> Path:
    """Make the derivative and return its anat folder."""
    raw, out = tmp_path / "raw", tmp_path / "out"
    make_derivative(session, result, session.stacks, raw, out, out / ".g3r" / "sub-01" / "derivative")
    assert not list((out / ".g3r").rglob("*.*"))
    return record_path(session, out).parent


def test_found_masks_are_derivatives_of_their_stacks(session: Session, result: Path, tmp_path: Path) -> None:
    anat = make(session, result, tmp_path)
    assert not (anat / "sub-01_run-1_desc-brain_mask.nii.gz").exists()
    assert (anat / "sub-01_run-2_desc-brain_mask.nii.gz").is_file()
    said = json.loads((anat / "sub-01_run-2_desc-brain_mask.json").read_text())
    assert said["Sources"] == ["bids:raw:sub-01/anat/sub-01_run-2_T2w.nii.gz"]
    assert said["Type"] == "Brain"
    assert (anat.parent / "figures" / "sub-01_rec-g3r_desc-masks_T2w.png").is_file()
    assert len(list(anat.glob("*_xfm.txt"))) == 3


def test_a_new_result_leaves_nothing_of_the_old_one(session: Session, result: Path, tmp_path: Path) -> None:
    anat = make(session, result, tmp_path)
    (anat / "sub-01_rec-g3r_dseg.nii.gz").write_bytes(b"of another tool")
    for name in ("brain-mask-1.nii.gz", "masks.png", "prior_share.nii.gz"):
        (result / name).unlink()
    names = {path.name for path in make(session, result, tmp_path).iterdir()}
    assert "sub-01_rec-g3r_dseg.nii.gz" in names
    assert not {name for name in names if "run-2_desc" in name or "priorshare" in name}
    assert {path.name for path in (anat.parent / "figures").iterdir()} == {
        f"sub-01_rec-g3r_desc-{kind}_T2w.{ending}"
        for kind, ending in (("sections", "png"), ("thumbnail", "png"), ("report", "html"))
    }


def test_killed_between_two_renames(session: Session, result: Path, tmp_path: Path) -> None:
    anat = make(session, result, tmp_path)
    (anat / "mine.txt").write_text("mine")
    staging = tmp_path / "out" / ".g3r" / "sub-01" / "derivative"
    staging.mkdir(parents=True)
    anat.rename(staging / "earlier-anat")
    assert (make(session, result, tmp_path) / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("source", "output", "url"),
    [
        ("study/raw", "study/raw/derivatives/g3r", "../.."),
        ("study/raw", "study/g3r", "../raw"),
        ("study/raw", "study/derivatives/g3r", "../../raw"),
        ("clinic/Doe_Jane/raw", "scratch/g3r", "raw"),
    ],
)
def test_the_link_names_no_folder_on_the_way(tmp_path: Path, source: str, output: str, url: str) -> None:
    assert relative_url(tmp_path / source, tmp_path / output) == url
