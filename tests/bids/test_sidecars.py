"""Inherited sidecars from parent folders, and the thickness that g3r-infer takes from them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from g3r.acquisition.slice_profile import find_slice_profile
from g3r.bids.dataset import find_sessions
from g3r.bids.sidecars import inherited, with_sidecar
from g3r.errors import InputError
from tests.bids.data_sets import add_session


def write(path: Path, **keys: object) -> None:
    path.write_text(json.dumps(keys))


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    add_session(tmp_path / "raw", "01", "1", [("acq-ax_run-1", b"x", None), ("acq-cor_run-1", b"x", None)])
    return tmp_path / "raw"


def test_nearer_files_win_and_others_do_not_count(raw: Path) -> None:
    axial, coronal = find_sessions(raw)[0].stacks
    assert inherited(axial, raw) is None
    write(axial.with_name("sub-01_ses-1_acq-ax_run-1_T2w.json"), PhaseResolution=0.7)
    assert inherited(axial, raw) is None  # g3r-infer reads the sidecar beside the image itself
    write(raw / "T2w.json", SliceThickness=4, PhaseResolution=0.5, SpacingBetweenSlices=5, PatientName="x")
    write(raw / "acq-ax_T2w.json", SliceThickness=3.5)
    write(raw / "acq-sag_T2w.json", SliceThickness=9)
    write(raw / "acq-cor_T2w.json", PatientName="x")
    write(raw / "T1w.json", SliceThickness=9)
    write(raw / "sub-01" / "ses-1" / "sub-01_ses-1_T2w.json", SpacingBetweenSlices=4)
    assert inherited(axial, raw) == {"SliceThickness": 3.5, "PhaseResolution": 0.7, "SpacingBetweenSlices": 4}
    assert inherited(coronal, raw) == {"SliceThickness": 4, "PhaseResolution": 0.5, "SpacingBetweenSlices": 4}


def test_the_link_has_all_keys_beside_it(raw: Path, tmp_path: Path) -> None:
    stack = find_sessions(raw)[0].stacks[0]
    write(raw / "T2w.json", SliceThickness=3.25)
    keys = inherited(stack, raw)
    assert keys
    for _ in range(2):  # a second run finds the link of the first run
        link = with_sidecar(stack, keys, tmp_path / "stacks")
    assert link.name == stack.name
    assert link.read_bytes() == b"x"
    profile = find_slice_profile(link, [1.0, 1.0, 4.0], 2, None, None)
    assert (profile.thickness_mm, profile.origin.thickness_from) == (3.25, "sidecar")


def test_a_file_that_is_no_json_is_named(raw: Path) -> None:
    (raw / "T2w.json").write_text("{")
    with pytest.raises(InputError, match=r"T2w\.json: is not JSON"):
        inherited(find_sessions(raw)[0].stacks[0], raw)


def test_keys_that_are_not_read_are_not_carried_on(raw: Path) -> None:
    write(raw / "T2w.json", PatientName="x", EchoTime=0.1)
    assert inherited(find_sessions(raw)[0].stacks[0], raw) is None
